"""A whole training run under observation: environments and a learner that keep a diary, and what follows from it.

`interface.py` says what a loop is given; `environment.py` and `learner.py` are those of the kit, which write into the
`Diary` of `diary.py`; `playing.py` runs a candidate with them. `records.py` makes the records of each worker of the
diary, and `expected.py` what chapters 11 and 12 demand of these. The checks are conformance/cases/running_loop.py and
going_on.py.
"""
