"""Readers of the data sets that the paper trains on, in the layouts that their sites publish; each answers scenes to draw samples from."""
