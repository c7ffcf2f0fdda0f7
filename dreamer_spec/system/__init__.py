"""The process and the machine that it runs on: cores, memory, threads, signals. Imports no NumPy."""
