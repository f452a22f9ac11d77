"""A scorer on one principle, measured beside the product's: a model of a healthy fan, Bayes factors of its faults.

`bins` makes bins of predictions, `operation` what drives the model within a bin; `healthy` is the model, a Kalman
filter; `faults` says how each fault changes it; `onsets` adds up the evidence to one statistic, `missing` that of
missing readings; `alarms` decides, `in_alarm` tells the causes of an alarm, and `method` makes a method of the bench of
it. No limit is calibrated: it is the declared time between false alarms. Priors are those of a population of fans and
of the twin's card; `learned` narrows or widens some of them by healthy runs.
"""
