"""Files that hold series, each value with its name and time: long tables, and exports of databases of time series."""
