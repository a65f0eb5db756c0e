"""The console: clips set up, measured and read in the browser, on this machine."""
