"""The console: a local web application in which clips are edited, measured and viewed."""
