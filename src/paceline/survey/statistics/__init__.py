"""Statistics of the vehicles that passed a site: percentiles, shares and means of their speeds, each with its interval.

Pure functions of aligned arrays, one element per passage, in SI units. Nothing here is random, and sums are taken over
arrays in the order in which they are given: equal arrays give equal bytes.
"""
