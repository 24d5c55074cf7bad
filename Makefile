# make setup | demo | reproduce | test | test-extended | coverage | docs | lint | clean   (PYTHON=... and VENV=... choose another interpreter, another place)

VENV ?= .venv
SCALE ?= quick
SEED ?= 0
.DEFAULT_GOAL := setup
.DELETE_ON_ERROR:
.PHONY: setup demo reproduce test test-extended coverage docs lint clean lock

# The first interpreter that runs and is new enough; a name alone proves nothing (version managers leave shims).
SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	$$p -c '$(SUPPORTED)' >/dev/null 2>&1 && { command -v $$p; break; }; done)

setup: $(VENV)/.ready

# Two stamps, each written last: an interrupted setup is done again, a finished one never.
$(VENV)/.locked: requirements.lock
	@'$(PYTHON)' -c '$(SUPPORTED)' 2>/dev/null || { \
	  echo "make: expected Python 3.11 to 3.13, found '$(or $(PYTHON),none)'; install one, or name it: make PYTHON=/path/to/python3" >&2; \
	  exit 1; }
	'$(PYTHON)' -m venv --clear '$(VENV)'
	'$(VENV)/bin/python' -m pip install --quiet --no-compile --disable-pip-version-check --require-hashes -r requirements.lock
	@touch '$@'

$(VENV)/.ready: $(VENV)/.locked pyproject.toml
	'$(VENV)/bin/python' -m pip install --quiet --no-compile --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch '$@'

# The robot in the browser, until Ctrl-C.
demo: setup
	@'$(VENV)/bin/lgmdjax' demo

reproduce: setup
	'$(VENV)/bin/lgmdjax' reproduce --scale $(SCALE) --seed $(SEED)

# Contracts, gradients, images, detectors, the closed loop and the robot's behaviour are compiled as users compile them;
# all other tests with other flags, which saves time. With ARGS, such as a file, all tests that it names run at once.
test: setup
ifdef ARGS
	'$(VENV)/bin/python' -m pytest $(ARGS)
else
	LGMDJAX_TEST_DEFAULT_XLA=1 '$(VENV)/bin/python' -m pytest -m 'default_xla and not extended'
	'$(VENV)/bin/python' -m pytest -m 'not default_xla and not extended'
endif

# What `make test` leaves out: gradients of batches, long derivatives, and the slowest notebooks.
test-extended: setup
	'$(VENV)/bin/python' -m pytest -m extended

# Lines that the tests reach, as a table and in build/coverage; needs half again as long as `make test`.
coverage: setup
	'$(VENV)/bin/python' -m pytest --cov --cov-report=term --cov-report=html $(ARGS)

# The pages, into build/docs; a warning or a link inside the site that leads nowhere is an error.
docs: setup
	rm -rf build/docs docs/generated
	JAX_PLATFORMS=cpu '$(VENV)/bin/python' -m sphinx --quiet --fail-on-warning --keep-going -b html docs build/docs
	'$(VENV)/bin/python' docs/check_links.py build/docs

lint: setup
	'$(VENV)/bin/ruff' check .
	'$(VENV)/bin/ruff' format --check .
	'$(VENV)/bin/pyright' --pythonpath '$(VENV)/bin/python'

clean:
	rm -rf '$(VENV)' .cache build dist .pytest_cache .ruff_cache .hypothesis

# For maintainers, with uv on the path: the newest versions that pyproject.toml allows, for every supported Python.
lock:
	uv pip compile pyproject.toml --extra dev --extra docs --extra notebooks --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-emit-find-links --no-annotate --custom-compile-command 'make lock' --output-file requirements.lock
