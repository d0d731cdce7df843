"""Texts of the verdict's sentences; `sentences` fills them in."""

HEADS = {
    "no_gap": "No gap above the noise: the logs differ from the simulator by {nominal}.",
    "parameters": "Only parameters are off, as far as these logs tell: recalibrated, the gap falls from {nominal} to "
    "{calibrated}.",
    "noise": "The noise is larger than estimated: what the recalibrated simulator leaves, {calibrated}, nothing "
    "predicts, and no force leaves such a trace.",
    "effects": "The simulator lacks {named}.",
    "ambiguous": "The simulator lacks something like {named}, but these logs fit other explanations as well.",
    "unexplained": "Something is missing that no effect of the library explains.",
}
ABOVE = {  # where the residual is above the noise
    "no_gap": "The logs differ from the simulator by {nominal}. That is more than the noise, but too little for these "
    "logs to tell what is missing.",
    "parameters": "The parameters are off: recalibrated, the gap falls from {nominal} to {calibrated}. That is more "
    "than the noise, but too little for these logs to tell what is missing.",
}
PARTLY = (
    "Partly explained: {named} {close} {realised} of the squared gap above the noise, but more than the tolerance "
    "remains at {beyond}."
)
REST = {
    "effects": "The simulator lacks {named}, and more than the tolerance remains at {beyond}.",
    "ambiguous": "The simulator lacks something like {named}, but these logs fit other explanations as well, and more "
    "than the tolerance remains at {beyond}.",
}
IMPERFECT = (
    "No candidate closes what remains, {remains_of} of the squared gap: the law is not quite that of the real system."
)
NEAREST = "Of the library, {named} {come} nearest"
BEATEN = "; a flexible force alone predicts held-out {held} far better"
ON_TOP = "; a flexible force on top of {them} still closes {remains} of the gap"
FALLS = (
    "With {them} the recalibrated simulator's gap falls from {calibrated} to {with_effects} on held-out {held}. "
    "Before {they} fitted, {predicted} of the squared gap above the noise was predicted to close; {realised} did."
)
ELSEWHERE = (
    "Where the effects are chosen anew without each operating condition in turn, they close {elsewhere} of the gap of "
    "the condition that was left out."
)
NESTED = (
    "For each operating condition the effects were chosen and fitted without it; the costs behind the choice were not, "
    "so these shares may be a little too high."
)
IN_SAMPLE = (
    "These numbers are in sample: one log is one operating condition, parts of it were held out, and nothing tells how "
    "they hold in another condition."
)
WITHIN = "What remains is within the tolerance at every joint: {within}."
PROBABLE = (
    "Probability of this explanation among all that were fitted: {share}; of the others that stand beside it: "
    "{others}; of the known parameters alone: {nothing}."
)
HIDDEN = (
    "Beside {them} these logs would not show {hidden}: parameters of what is named do the same, and stand for both "
    "where both are there."
)
STANDS_FOR = (
    "The data sheet may be wrong at {parameters}, or the simulator lacks {effects}: both move the robot alike. "
    "--accuracy weighs the two."
)
BUILDS_UP = (
    "Over whole logs the error grows to {times} times what noise, start and parameters make likely, though within "
    "{window} it hardly shows: the law, or the simulator's time step, is not quite right."
)
BENT = (
    "This needs {far} of {known} known parameters far from the data sheet, by chance less often than in 1 of 10 000 "
    "robots even if it is half as inaccurate again as stated: something else may be missing in their place, or the "
    "data sheet is not this robot's (--accuracy, --parameters)."
)
OF_SENSORS = "What remains has the covariance of noise of the sensors, {colour}."
CHANCE = (
    "What remains, {calibrated}, no candidate and no flexible force predicts on held-out {held}: process noise, an "
    "input that was not logged, or noise larger than estimated."
)

COASTS = (
    "Joints that just keep their speed in a window, without any simulator, are {coasting} noise sd off, less than the "
    "recalibrated simulator's {calibrated}{more}: its forces are far off, or hardly show in windows as short as these."
)
COASTS_CLOSED = "; of that squared gap the effects close {closed}"
STUCK = "At a bound, where they stand in for something else or their range is too narrow: {named}."
FAR = "Far from the data sheet: {named}."
