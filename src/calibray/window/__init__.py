"""The window: a local web page for a study's folder, for people who do not use a terminal.

The page runs the commands of the command line as separate processes, and shows the files that these commands read and
write.
"""
