"""Support of long work.

progress      a bar with rate and time left, or plain lines
stopping      SIGINT, SIGTERM and SIGHUP
compiling     compiled steps that take little memory
"""
