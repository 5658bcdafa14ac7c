"""Support of long work.

progress      a bar with rate and time left, or plain lines
stopping      SIGINT and SIGTERM
compiling     compiled steps that take little memory
"""
