"""A scorer on one principle, measured beside the product's: a model of a healthy fan, Bayes factors of its faults.

`bins` makes bins of predictions, `operation` what drives the model within a bin; `healthy` is the model, a Kalman
filter; `faults` says how each fault changes it; `onsets` adds up the evidence to one statistic, `missing` that of
missing readings; `alarms` decides, and `method` makes a method of the bench of it. Nothing is calibrated: priors are
those of a population of fans and of the twin's card, and the limit is the declared time between false alarms.
"""
