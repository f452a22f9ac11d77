"""The model of a healthy fan, Bayes factors of its faults, and the decision that follows from both.

`bins` makes bins of predictions, `operation` what drives the model within a bin; `healthy` is the model, a Kalman
filter; `faults` says how each fault changes it; `onsets` adds up the evidence to one statistic, `missing` that of
missing readings; `decision` raises and ends alarms, `in_alarm` tells the causes of one. The limit is the declared mean
time between two false alarms, in bins; it is not tuned. Priors are those of a population of fans (`priors`) and of the
twin's card; `learned` narrows or widens some of them by healthy runs. See docs/explanation/deciding.md.
"""
