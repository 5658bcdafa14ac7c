"""Support of long work.

progress      a bar with rate and time left, or plain lines
stopping      SIGINT, SIGTERM and SIGHUP
compiling     compiled steps that take little memory
pool          items of work on all cores of this machine
cluster       the same on the workers of a Dask cluster
memory        the most that a process held
viewers       KLayout and the system's viewer
doctor        versions, devices, memory, extras and programs of this installation
"""
