"""The commands, one module each; `paceline.cli` gathers them."""

DONE, NOTHING_MEASURED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130  # exit statuses
