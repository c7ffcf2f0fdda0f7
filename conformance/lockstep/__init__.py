"""Level 4: whole training steps of several implementations side by side, from the same parameters, data and noise."""
