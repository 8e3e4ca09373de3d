# Two commands do all set-up on a machine that has Python 3.10 or later, its venv module and make:
#   make demo    a simulated recording, its calibration, a compensated bag and a report
#   make test    the core and the live lane of the tests; make test-long runs the longest tests
# With a ROS 2 Jazzy sourced its rclpy is used, otherwise rclpy comes from PyPI; all versions are pinned in constraints/.

PYTHON ?= python3
# `set -o pipefail` of demo-check.
SHELL = /bin/bash
VENV ?= .venv
PY = $(VENV)/bin/python
OUTPUT ?= demo
TEST_OPTIONS ?=
SOAK_HOURS ?= 6
MINUTES ?= 10

# One thread per process: the tests run on two cores already, and sums come out in the same order every time.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# Containers often ask for no bytecode: every node and command that a test starts, and pytest for every test file, would compile all anew.
unexport PYTHONDONTWRITEBYTECODE

ifeq ($(ROS_DISTRO),jazzy)
JAZZY := $(shell $(PYTHON) -c 'import rclpy' 2>/dev/null && echo yes)
endif

ifeq ($(JAZZY),yes)
PINS ?= constraints/jazzy-ubuntu2404.txt
VENV_OPTIONS = --system-site-packages
# ROS registers pytest plugins of its own, written for other pytest versions.
export PYTEST_DISABLE_PLUGIN_AUTOLOAD = 1
PLUGINS = -p xdist
else ifeq ($(shell $(PYTHON) -c 'import sys; print(sys.version_info < (3, 11))' 2>/dev/null),True)
# The latest numpy and scipy need Python 3.11.
PINS ?= constraints/oldest.txt
else
PINS ?= constraints/pypi.txt
endif

STAMP = $(VENV)/.installed-$(notdir $(basename $(PINS)))
PIP = $(PY) -m pip --disable-pip-version-check --no-input install --quiet --prefer-binary --use-pep517
# Every line of the list and of those that it names. The lists are complete: nothing is resolved.
ALL_PINS = cat $(PINS) $$(sed -n 's|^-r |constraints/|p' $(PINS)) | sed -n 's/ *\#.*//; /^[A-Za-z]/p'
# uv installs a list in seconds. It does not read the configuration of pip: an index that pip has in place of PyPI needs pip.
UV = test -x $(VENV)/bin/uv && ! $(PY) -m pip config list </dev/null | grep -q '[.]index-url=' && \
  $(VENV)/bin/uv pip install --quiet --python $(PY)
# $(call install,OPTIONS): options that both have.
install = { $(UV) $(1); } || $(PIP) $(1)
# Four processes on two cores: live tests mostly wait. conftest.py orders the files. test/run_lanes.py repeats live tests that failed.
LANES = $(PY) test/run_lanes.py
PROCESSES = $(PLUGINS) -n 4
README_TEST = test/cli/test_pages.py

.PHONY: help setup dist rosdebian demo demo-check readme-check live-demo test test-live test-long test-all test-fast mutants lint lint-tools lint-code lint-types lint-size lint-words oracles test-oldest validate config answers bench soak fuzz noise-coverage hide-and-seek docs clean

help:
	@sed -n '1,4s/^# \{0,1\}//p' $(MAKEFILE_LIST)
	@echo 'also: setup, dist, rosdebian, live-demo, test-live, test-long, test-all, test-fast, lint, oracles, test-oldest, validate, config, answers, bench, soak, fuzz, noise-coverage, hide-and-seek, docs, clean'

setup: $(STAMP)

$(STAMP): $(filter-out $(addprefix constraints/,docs.txt rosdebian.txt validate.txt oracles.txt oracles-alone.txt lint.txt),$(wildcard constraints/*.txt)) setup.py setup.cfg
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	  { echo 'Python 3.10 or later is needed, $(PYTHON) is older or missing; run: make PYTHON=/path/to/python3' >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || \
	  { echo 'The venv module of $(PYTHON) is missing; run: apt-get install python3-venv' >&2; exit 1; }
	@echo 'Installing $(PINS) into $(VENV), once: some seconds, or a minute or two with a slow network.'
	@$(PY) -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV_OPTIONS) $(VENV)
	@$(PIP) $$($(ALL_PINS) | grep -oE '^(pip|setuptools|uv|wheel)==[0-9.]+')
	@$(ALL_PINS) | { $(UV) --no-deps --no-build-isolation --requirement -; } || \
	  $(ALL_PINS) | xargs -d '\n' -n 45 -P 4 $(PIP) --no-deps --no-build-isolation
	@$(call install,--no-deps --no-build-isolation --editable .)
	@touch $@

demo: $(STAMP)
	@$(PY) examples/demo.py --output $(OUTPUT)

# The demonstration in a temporary folder; its errors are compared with the README.
demo-check: $(STAMP)
	@folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && set -o pipefail && \
	  $(PY) examples/demo.py --output "$$folder/demo" | tee "$$folder/log" && $(PY) tools/demo_figures.py "$$folder/log"

# The source distribution and the wheel made of it, as the package index accepts them.
# setuptools unpacks the tree of a source distribution where it runs: in a folder of links, so that `make lint` beside it does not read a second tree.
dist: $(STAMP)
	@rm -rf dist build && folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && ln -s "$(CURDIR)"/* "$$folder" && \
	  cd "$$folder" && "$(abspath $(PY))" setup.py --quiet sdist --dist-dir "$(CURDIR)/dist"
	@$(PY) -m pip --disable-pip-version-check wheel --quiet --no-deps --no-build-isolation --wheel-dir dist dist/*.tar.gz
	@if $(PY) -c 'import twine' 2>/dev/null; then $(PY) -m twine check --strict dist/*; else echo 'twine is not in $(PINS): dist/ is not checked'; fi

# debian/ of the ROS package in build/, by bloom and a list of keys that was written by hand (no network but that of pip).
rosdebian: .venv-rosdebian/.installed
	@bash tools/rosdebian.sh .venv-rosdebian/bin build

.venv-rosdebian/.installed: constraints/rosdebian.txt
	@$(PYTHON) -m venv .venv-rosdebian
	@.venv-rosdebian/bin/python -m pip --disable-pip-version-check --no-input install --quiet --requirement $<
	@touch $@

# Every code block of the README runs, or has its reason in NOT_RUN of the test; a skipped test fails. The wheel runs, in an environment
# that has only it; requirements and pytest are those of $(VENV).
readme-check: dist
	@set -e; folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && wheel=$$folder/wheel/bin/python; \
	$(PY) -m venv --without-pip $$folder/wheel; \
	$(PY) -m pip --disable-pip-version-check --quiet --python $$wheel install --no-deps dist/*.whl; \
	site=$$($$wheel -c 'import sysconfig; print(sysconfig.get_path("purelib"))'); \
	$(PY) -c 'import sysconfig; print(sysconfig.get_path("purelib"))' >$$site/requirements.pth; \
	cd $$folder; IMPORTED_FROM=$$site $$wheel -m pytest $(PLUGINS) -n 2 --dist load --fail-skipped -o pythonpath=test \
	  -p no:cacheprovider -c $(CURDIR)/pytest.ini --rootdir $(CURDIR) $(CURDIR)/$(README_TEST)

live-demo: $(STAMP)
	@$(PY) examples/live_demo.py --output $(OUTPUT)

test: $(STAMP)
	$(LANES) core live -- $(PROCESSES) --dist loadfile $(TEST_OPTIONS)

test-live: $(STAMP)
	$(LANES) live -- $(PROCESSES) --dist loadfile $(TEST_OPTIONS)

# The longest tests, distributed one by one rather than by file.
test-long: $(STAMP)
	$(LANES) long -- $(PROCESSES) --dist load $(TEST_OPTIONS)

# All lanes in one call, where tests of several lanes share what their file makes once.
# After `make readme-check` the test of the README is left out with README_CHECKED=yes.
test-all: $(STAMP)
	$(LANES) core live long -- $(PROCESSES) --dist loadfile $(if $(README_CHECKED),--ignore=$(README_TEST)) $(TEST_OPTIONS)

# The core lane: no DDS, no other processes, no browser. Two processes, because no test waits.
test-fast: $(STAMP)
	$(LANES) core -- $(PLUGINS) -n 2 --dist loadfile $(TEST_OPTIONS)

# Libraries that some tests compare with; without them these tests are skipped.
oracles: $(STAMP)
	@$(call install,--constraint $(PINS) --requirement constraints/oracles.txt)
	@$(call install,--no-deps --requirement constraints/oracles-alone.txt)

# Unused names and arguments, line length, docstrings, annotations, size of the product, marker words: less than a minute, half with -j2.
lint: lint-code lint-types lint-size lint-words

lint-tools: $(STAMP)-lint

lint-code: $(STAMP)-lint
	$(VENV)/bin/ruff format --check --quiet --output-format concise .
	$(VENV)/bin/ruff check --output-format concise .

lint-types: $(STAMP)-lint
	$(VENV)/bin/mypy

lint-size: $(STAMP)
	@$(PY) tools/weigh.py

lint-words: $(STAMP)
	@$(PY) tools/plain.py
	@$(PY) tools/quoted_names.py

$(STAMP)-lint: $(STAMP) constraints/lint.txt
	@$(call install,--requirement constraints/lint.txt)
	@touch $@

# The same tests on the oldest supported versions, those of Ubuntu 24.04; needs Python 3.10 to 3.12.
test-oldest:
	$(MAKE) test-all VENV=.venv-oldest PINS=constraints/oldest.txt JAZZY=

# Each fault of test/mutants/declared.py put into a copy of the code, one at a time: which faults does no test notice?
mutants: $(STAMP)
	@$(PY) test/mutants/run.py

# Everything on the real recordings (IMU_CALIBRATION_DATA, default ../shared/data), beside other packages; writes docs/validation.md.
validate: $(STAMP)-validate
	@$(PY) validation/run.py

$(STAMP)-validate: $(STAMP) constraints/validate.txt
	@$(call install,--constraint $(PINS) --requirement constraints/validate.txt)
	@touch $@

# The parameter files of the nodes from what the nodes declare, the tolerances from the catalogue of effects.
config: $(STAMP)
	@$(PY) -m tools.parameter_files
	@$(PY) -m tools.tolerance_file

# Pages that are written from what runs: the targets of exports, the answers with their commands and pictures.
answers: $(STAMP)
	@$(PY) -m tools.exports_page
	@$(PY) examples/answers.py

# Noise identified on 204 simulated records of ten minutes to three hours: intervals and errors, the tables of docs/noise.md; half an hour.
noise-coverage: $(STAMP)
	@$(PY) benchmarks/noise_records.py --write

bench: $(STAMP)
	@$(PY) benchmarks/run.py

soak: $(STAMP)
	@$(PY) test/ros/soak.py --hours $(SOAK_HOURS)

# Mutated recordings, documents and messages for every reader, with limits of memory and processor time; fails on a finding.
fuzz: $(STAMP)
	@$(PY) test/fuzz/run.py --minutes $(MINUTES)

hide-and-seek: $(STAMP)
	@$(PY) validation/hide_and_seek.py

# The pages as a searchable site for a browser without a network; warnings and requests to other hosts are errors.
docs: .venv-docs/.installed
	@NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --quiet
	@echo 'written: site/index.html'

.venv-docs/.installed: constraints/docs.txt
	@$(PYTHON) -m venv .venv-docs
	@.venv-docs/bin/python -m pip --disable-pip-version-check --no-input install --quiet --requirement $<
	@touch $@

clean:
	rm -rf site build dist install log $(OUTPUT) out .pytest_cache .hypothesis *.egg-info
	find . -name __pycache__ -not -path './.venv*' -prune -exec rm -rf {} +
