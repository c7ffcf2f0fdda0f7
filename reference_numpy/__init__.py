"""The reference: every equation of the specification in plain float64 NumPy, one module for each chapter.

Written to be read beside its chapter, not to be fast. Nothing here differentiates; `stop_gradient` makes central
differences of these functions equal to the gradients that automatic differentiation must give.
"""
