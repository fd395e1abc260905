"""Strict reading and atomic writing of files. All code that depends on a file format is in this folder."""
