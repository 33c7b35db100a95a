# Two commands do everything on a machine with python3 and make: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
STAMP = $(VENV)/.installed
CUDA ?= # make install CUDA=1 adds the CUDA build of JAX

.PHONY: help install demo test test-ci test-types test-slow test-browser check docs notebook clean

help: ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 14

install: $(STAMP) ## virtual environment in .venv with everything in tested versions

# --no-compile: Python compiles what it imports; all 12,700 files of the packages would take a minute
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "error: Python 3.11 or newer is needed, this is " + sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[dev$(if $(CUDA),$(comma)cuda)]'
	@touch $@
comma := ,

demo: $(STAMP) ## a page of a policy of the package that drives among traffic; then train cars on generated roads, and judge them on unseen ones
	$(BIN)/python -m scenefactory_jax view run=drive overrides='[traffic=idm]' out=runs/drive.html
	$(BIN)/python -m scenefactory_jax train experiment=demo

TEST = $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test: $(STAMP) ## the fast tests, a chosen set
	$(TEST)

test-ci: $(STAMP) ## tests of whole runs and of programs that take long to compile, which CI runs, too
	$(TEST) -m "ci and not slow and not gpu"

test-types: $(STAMP) ## both with all annotations checked, shapes included; before a release
	$(TEST) -m "not slow and not gpu" --jaxtyping-packages=scenefactory_jax,beartype.beartype

test-slow: $(STAMP) ## all other tests, before a release
	XLA_FLAGS= $(BIN)/python -m pytest -m slow --ignore tests/test_digests.py
	$(BIN)/python -m pytest -m slow tests/test_digests.py # recorded with the flags of the fast tests

test-browser: $(STAMP) ## the replay's page in a headless browser; needs Chromium or Chrome
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[browser]'
	$(BIN)/python -m pytest tests/visualization/test_replay_browser.py

check: $(STAMP) ## style and types
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: $(STAMP) ## the site of docs/, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

notebook: $(STAMP) ## run the notebooks and keep their outputs
	$(BIN)/jupyter execute --inplace notebooks/*.ipynb

clean: ## remove what was built, not what was trained
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache *.egg-info
