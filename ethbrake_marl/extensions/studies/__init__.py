"""The folder of a study of many training runs, and the machine on which it ran."""
