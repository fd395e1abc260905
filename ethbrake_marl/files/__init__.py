"""Reading and writing files: strict reading, atomic writing. No other folder knows a file format."""
