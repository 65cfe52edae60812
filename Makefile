# `make run` and `make test` are all that a user needs. Each sets up a virtual environment first.
PYTHON ?= python3.11
VENV ?= .venv
# Package index with CPU builds of torch, where the default index serves gigabytes of CUDA:
#   make run TORCH_INDEX=https://...    (the "cpu" index of the PyTorch project, or a mirror of it)
TORCH_INDEX ?=
PIP_FLAGS := $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX),)
BIN := $(VENV)/bin
ARGS ?=

DEFAULT_TESTS := not slow and not docker and not hf and not eai and not peers

.PHONY: run install test test-unit test-slow test-random test-random-hour fuzz house lint types contracts proto proto-check check site diagrams compose-check wheel physics-wheel pictures clean

run: $(VENV)/.runtime
	$(BIN)/embomatrix demo $(ARGS)

# EmboMatrix in the virtual environment, without training.
install: $(VENV)/.runtime

# All default tests, one process per core and at most eight. Tests of one file share costly fixtures, so a file stays in one
# process. `ARGS=-n0` runs everything in one process and shows what tests print.
test: $(VENV)/.dev
	$(BIN)/python -m pytest -n logical --maxprocesses=8 --dist=loadfile -m "$(DEFAULT_TESTS)" $(ARGS)

# Tests without physics and without processes, in a minute.
test-unit: $(VENV)/.dev
	$(BIN)/python -m pytest tests/unit -n logical --maxprocesses=8 --dist=loadfile -m "$(DEFAULT_TESTS)" $(ARGS)

test-slow: $(VENV)/.dev
	$(BIN)/python -m pytest -m "slow or hf or eai or peers" $(ARGS)

# Property tests with new inputs in every run. `ARGS="-k lease"` narrows the search.
test-random: $(VENV)/.dev
	HYPOTHESIS_PROFILE=random $(BIN)/python -m pytest -n logical --maxprocesses=8 --dist=loadfile -m "hypothesis and not docker" $(ARGS)

# The same again and again for an hour at the lowest priority; ends at the first failure. `SECONDS_LEFT=600` is shorter.
SECONDS_LEFT ?= 3600
test-random-hour: $(VENV)/.dev
	end=$$(($$(date +%s) + $(SECONDS_LEFT))); while [ $$(date +%s) -lt $$end ]; do \
	  HYPOTHESIS_PROFILE=random nice -n 19 $(BIN)/python -m pytest tests/unit tests/integration -n 1 -p no:cacheprovider -q \
	    -m "hypothesis and not docker and not slow" $(ARGS) || exit 1; \
	done

# Inputs that break a decoder, searched for `SECONDS_LEFT` seconds and kept in build/fuzz. The search is guided by coverage after
# `pip install -e .[fuzz]`. `ARGS='plan "scene file"'` narrows it.
fuzz: $(VENV)/.dev
	nice -n 10 $(BIN)/python -m tests.fuzz.search --seconds $(SECONDS_LEFT) $(ARGS)

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/mypy

contracts: $(VENV)/.dev
	$(BIN)/lint-imports

proto: $(VENV)/.dev
	PYTHON=$(BIN)/python proto/generate.sh

proto-check: $(VENV)/.dev
	proto/check.sh $(BIN)/buf

check: lint types contracts proto-check

# Figures of the code base: lines, modules per folder, import cycles, name clashes, banned docstring openings, unit-test time.
house: $(VENV)/.dev
	$(BIN)/python bench/house.py $(ARGS)

# Documentation site in build/site. `make site ARGS=serve` shows it live.
site: $(VENV)/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs $(if $(ARGS),$(ARGS),build --strict)

# Redraw the committed pictures of changed Mermaid diagrams. Needs npm and Chromium.
diagrams:
	mkdir -p build/mermaid && cd build/mermaid && npm pack --silent mermaid@11.17.2 && tar -xf mermaid-*.tgz package/dist/mermaid.min.js
	$(PYTHON) deploy/site/diagrams.py docs build/mermaid/package/dist/mermaid.min.js

compose-check: $(VENV)/.dev
	deploy/docker/local_bases.sh
	$(BIN)/python -m pytest -m docker $(ARGS)

# Source distribution, and the wheel built from it, in build/dist. CONTRIBUTING.md lists the steps of a release.
wheel: $(VENV)/.dev
	rm -rf build/dist
	$(BIN)/python -m build --no-isolation --outdir build/dist

# PyBullet for a Python without a wheel on the index: `make physics-wheel PYTHON=python3.12`. Needs a C++ compiler.
physics-wheel:
	deploy/physics/build_wheel.sh $(PYTHON) build/dist

pictures: $(VENV)/.dev
	$(BIN)/embomatrix scene draw Rs_int Wainscott_0_int restaurant_diner --format jpg --out docs/pictures --force
	$(BIN)/embomatrix scene draw docs/examples/two_bedroom_flat.toml --out build/pictures --force
	cp build/pictures/two_bedroom_flat_plan.png docs/pictures/
	$(BIN)/embomatrix scene draw Rs_int Wainscott_0_int restaurant_diner --as views --format jpg --out docs/pictures --force
	$(BIN)/embomatrix scene draw --all --as sheet --out docs/pictures --force
	$(BIN)/embomatrix scene draw --as relations --format jpg --out docs/pictures --force
	$(BIN)/embomatrix play Rs_int-train-000-03 --oracle --mode physical --film docs/pictures/physical.gif
	$(BIN)/python deploy/site/skill_films.py docs/pictures/skills

clean:
	rm -rf build runs

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV) || python3 -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/.runtime: $(VENV)/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet $(PIP_FLAGS) -c constraints.txt -e '.[all]'
	touch $@

$(VENV)/.dev: $(VENV)/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet $(PIP_FLAGS) -c constraints.txt -e '.[dev]'
	touch $@ $(VENV)/.runtime
