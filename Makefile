# Two commands on a fresh machine with only Python >= 3.11 and make:  make train   make test
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
BACKEND ?= jax

.PHONY: train test bench docs lint clean

train: $(VENV)/.installed
	$(RUN)/train --backend $(BACKEND)

test: $(VENV)/.installed
	$(RUN)/ruff format --check .
	$(RUN)/ruff check .
	$(RUN)/mypy
	$(RUN)/conformance coverage
	$(RUN)/pytest -n 2 --dist loadgroup

bench: $(VENV)/.installed
	$(RUN)/python -m benchmarks.train_step

docs: $(VENV)/.installed
	$(RUN)/python -m docs.render

lint: $(VENV)/.installed
	$(RUN)/ruff format .
	$(RUN)/ruff check --fix .
	$(RUN)/mypy

# PyTorch first and by its version in constraints.txt: what else needs it then takes the build that is there.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(RUN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV)
