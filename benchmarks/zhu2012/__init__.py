"""The tables and figures of [Zhu], one script each; what they share with [NIST]'s stands here too."""
