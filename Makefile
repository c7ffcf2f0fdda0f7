# Two commands on a fresh machine with only Python >= 3.11 and make:  make train   make test
PYTHON ?= python3
BACKEND ?= jax
RUN := .venv/bin
INSTALL := $(RUN)/python -m pip install --quiet --disable-pip-version-check
UV := .venv-uv/bin/uv
# What test-lowest and test-newest install and test. PyTorch is gigabytes there; with it: RANGES=jax,torch,dm-control,test RANGE_TESTS=tests
RANGES ?= jax,dm-control,test
RANGE_TESTS ?= $(addprefix tests/test_,$(addsuffix .py,learners reference_agent reference_replay reports skeleton spec train_cli train_envs \
	train_logger train_loop train_replay train_report)) -k 'not torch and not in_the_other'

.PHONY: train test test-slow test-lowest test-newest test-suites bench docs lint lock clean

train: .venv/.installed
	$(RUN)/train --backend $(BACKEND)

test: .venv/.installed
	$(RUN)/ruff format --check .
	$(RUN)/ruff check .
	$(RUN)/mypy
	$(RUN)/conformance coverage
	$(RUN)/pytest -n 2 --dist loadgroup

test-slow: .venv/.installed
	$(RUN)/pytest -m slow

# The two ends of the ranges in pyproject.toml, each in an environment of its own; the lock has no say here.
test-lowest: .venv-lowest/.tested
test-newest: .venv-newest/.tested
.venv-lowest/.tested: RESOLUTION := lowest-direct
.venv-newest/.tested: RESOLUTION := highest
.PHONY: .venv-lowest/.tested .venv-newest/.tested

.venv-lowest/.tested .venv-newest/.tested: $(UV)
	$(UV) venv --quiet --clear --python $(PYTHON) $(@D)
	$(UV) pip install --quiet --python $(@D) --resolution $(RESOLUTION) --override requirements/overrides.txt -e '.[$(RANGES)]'
	$(UV) pip freeze --quiet --python $(@D) --exclude-editable
	$(@D)/bin/pytest -n 2 --dist loadgroup $(RANGE_TESTS)
	$(@D)/bin/train --backend $(BACKEND) --steps 2000 --logdir $(@D)/run --resume never

# The suites with their packages, those too that the lock cannot hold: sources to be built, and ProcGen, which asks for an older NumPy.
PROCGEN = $(shell $(PYTHON) -c 'import sys; print("procgen-mirror==0.10.7 gym3==0.3.3 cffi pycparser" if sys.version_info < (3, 13) else "procgen-gym==0.1.1")')
test-suites: $(UV)
	$(UV) venv --quiet --clear --python $(PYTHON) .venv-suites
	$(UV) pip install --quiet --python .venv-suites --override requirements/overrides.txt -e '.[jax,dm-control,atari,bsuite,crafter,minigrid,test]'
	$(UV) pip install --quiet --python .venv-suites --no-deps $(PROCGEN)
	.venv-suites/bin/pytest -n 2 --dist loadgroup -rs tests/test_bsuite_scores.py $(foreach suite,atari bsuite crafter dm minigrid procgen suites,$(wildcard tests/test_train_$(suite)*.py))

bench: .venv/.installed
	$(RUN)/python -m benchmarks.train_step

docs: .venv/.installed
	$(RUN)/python -m docs.render

lint: .venv/.installed
	$(RUN)/ruff format .
	$(RUN)/ruff check --fix .
	$(RUN)/mypy

# Everything but PyTorch by its hash; then PyTorch, whose files differ between platforms, by the versions in torch.txt.
.venv/.installed: pyproject.toml requirements/lock.txt requirements/torch.txt
	$(PYTHON) -c 'import sys; sys.exit("Python >= 3.11 is needed: make PYTHON=..." if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv .venv
	$(INSTALL) --no-deps --require-hashes --only-binary :all: -r requirements/lock.txt
	$(INSTALL) -c requirements/torch.txt torch
	$(INSTALL) --no-deps --no-build-isolation -e .
	touch $@

# Renews both files to the newest versions within the ranges of pyproject.toml and requirements/pins.txt, for every Python and platform.
COMPILE := $(UV) pip compile --quiet --upgrade --universal --python-version 3.11 --custom-compile-command 'make lock' --annotation-style line
lock: $(UV)
	echo torch | $(COMPILE) - --constraints requirements/pins.txt --output-file requirements/torch.txt
	$(COMPILE) pyproject.toml --extra dev --generate-hashes --override requirements/overrides.txt \
		--constraints requirements/pins.txt --constraints requirements/torch.txt --output-file requirements/lock.txt \
		$$(sed -nE 's/^((torch|triton|cuda|nvidia)[a-z0-9-]*)==.*/--no-emit-package \1/p' requirements/torch.txt)

$(UV):
	$(PYTHON) -m venv .venv-uv
	.venv-uv/bin/python -m pip install --quiet --disable-pip-version-check 'uv>=0.9'

clean:
	rm -rf .venv .venv-uv .venv-lowest .venv-newest .venv-suites
