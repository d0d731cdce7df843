"""Numbers that several parts of the inference share; the others stand beside the formula that needs them."""

import numpy as np
from scipy.stats import norm

# draws, rows or features behind one estimate: a mean is known to 1/64 of a standard deviation; source: cost alone
DRAWS = 4096
# the same where an estimate is made for each of many: 1/8 of a standard deviation, levels in steps of 1/64; steps of an
# iteration that costs as little. source: cost alone
FEW = 64
AT_ONCE = 1024  # trajectories, or thetas, of one call; source: memory alone
# of an iteration that ends by itself, at most; source: rule of thumb. Recalibrations end after 1.9 to 3.9
# (benchmarks/records/posteriors_corners.json)
TURNS = 8
ALPHA = 0.01  # chance of a false finding; source: the usual strict level of a test
SURE = float(norm.isf(ALPHA / 2))  # standard errors that chance exceeds so often, on either side
NEGLIGIBLE = 0.05  # share that makes no difference to a person; source: rule of thumb, not counted
# share of draws, of steps or of a training that does not follow what was learnt, in case that it is wrong. source: rule
# of thumb; methods of Hesterberg 1995 (draws from the prior) and ter Braak 2006 (every tenth step)
DEFENSIVE = 0.1
WIDER = 1.2  # factor on the standard deviations of a fitted proposal; source: rule of thumb, not counted
# sd of the log of a factor on standard deviations beforehand: a few rows or sets are off by chance (9486466).
# source: rule of thumb, not counted
DOUBT = 0.2

EPS = float(np.finfo(np.float32).eps)  # rounding of float32
ROUNDED = float(np.log(EPS))  # log mass: less is rounding beside 1
