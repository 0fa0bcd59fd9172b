# `make demo` runs the whole method on the virtual robot; `make test` checks the code.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# uv installs the same packages as pip: all that tests need in 31 s in place of 140 s. It reads no
# settings of pip: folders with wheels are passed on, and where it cannot install, pip does.
UV := $(BIN)/uv pip install --quiet --no-cache --python $(BIN)/python
comma := ,
empty :=
export UV_FIND_LINKS := $(subst $(empty) ,$(comma),$(PIP_FIND_LINKS))
export UV_NATIVE_TLS := 1
# Of 25,000 installed modules those alone are compiled that are imported, once for all processes.
unexport PYTHONDONTWRITEBYTECODE
export PYTHONPYCACHEPREFIX := $(CURDIR)/build/bytecode
# A module in one process, in the order of tests/conftest.py.
DEAL := --dist loadscope --no-loadscope-reorder
# Which live tests have failed; the other tests have a cache of their own.
LIVE_CACHE := -o cache_dir=build/live-tests
LIVE_FAILED := build/live-tests/failed
WHEN_IDLE := $(shell chrt --idle 0 true 2>/dev/null && echo chrt --idle 0 || echo nice -n 19)

.PHONY: demo test test-slow check docs lint ci ci-live ci-live-again ci-idle ci-others clean

demo: $(VENV)/.core
	$(BIN)/pronk demo --out out/demo

test: check
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 $(DEAL) -m "not live and not slow" --durations=30

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

# Trainings, whole trials and processes in real time.
test-slow: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 $(DEAL) -m "slow and not live" --durations=10
	OMP_NUM_THREADS=1 $(BIN)/pytest tests/live --durations=10

# All of the above and the site. Live tests run one after another, since two at once missed states.
# All else runs beside them, but only while a core is idle: SCHED_IDLE, in the same session, for
# which anything else that wants to run takes the core at once. Types and the site are checked
# there too, so that live tests, which take longest, begin as soon as all is installed.
#
# Live tests that fail are run again when all else has ended, and have to pass then: programs in real
# time do fail where the machine stands still for 50 to 200 ms, which virtual machines do.
ci: $(VENV)/.dev
	rm -f $(LIVE_FAILED)
	$(MAKE) -j 4 --output-sync=target ci-live ci-idle
	if [ -e $(LIVE_FAILED) ]; then $(MAKE) ci-live-again; fi

# Status 1 of pytest: tests have failed, and nothing else has.
ci-live: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest tests/live $(LIVE_CACHE) --durations=10 \
		|| { test $$? -eq 1 && touch $(LIVE_FAILED); }

ci-live-again: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest tests/live $(LIVE_CACHE) --last-failed -v

# Its jobs are some of the four of `ci`.
ci-idle: $(VENV)/.dev
	$(WHEN_IDLE) $(MAKE) check docs ci-others

ci-others: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 $(DEAL) -m "not live" --durations=40

# The documentation site, in build/docs.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

lint: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# The core install, and what jumps and films need: no PyTorch.
$(VENV)/.core: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install --no-compile -c constraints.txt -e .[policy,video]
	touch $@

# Everything the tests and the site need, in one go, so that dependencies are resolved once. PyTorch
# is named so that its pinned build is taken.
DEV_PACKAGES := -c constraints.txt torch==2.13.0 \
	-e .[train,bench,hardware,video,play,engines,cluster,dev,docs]
$(VENV)/.dev: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install --no-compile -c constraints.txt uv || true
	$(UV) $(DEV_PACKAGES) || $(PIP) install --no-compile $(DEV_PACKAGES)
	touch $@ $(VENV)/.core $(VENV)/.docs

# The site alone.
$(VENV)/.docs: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install --no-compile -c constraints.txt -e .[docs]
	touch $@

clean:
	rm -rf $(VENV) out
