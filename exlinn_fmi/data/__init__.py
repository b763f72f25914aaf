"""Excitation signals, data sets, derivative estimates, and files that appear whole or not at all."""
