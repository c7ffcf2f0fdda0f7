"""The PyTorch backend, written from the chapters in spec/. One file per chapter, functions in the order of the chapter.

Beside the chapters there are `shapes.py` (checks of arguments, precisions), `parameters.py` (the parameter table as an
`nn.Module` over one flat buffer), `scan.py` (the recurrence over a sequence with a hand-written backward pass) and
`learner.py` (what training talks to).
"""
