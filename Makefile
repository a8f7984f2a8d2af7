# make run    play the thesis's 15 % loss experiment and write a report
# make check  run lint, types and the essential tests, in two minutes on two idle cores
# make test   run all tests, in 20 minutes on two idle cores
# All set up what they need: Debian packages (asking sudo if you are not root) and a virtual environment in .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SUDO := $(if $(filter 0,$(shell id -u)),,sudo)
SCENARIO ?= scenarios/loss_15.yaml
TESTS ?= -n 2
FUZZ_SECONDS ?= 10
TARGETS ?=

ESSENTIAL := tests/ucp tests/harness/archive tests/harness/checker tests/harness/run tests/harness/scenario \
  tests/harness/test_api.py tests/harness/test_rooms.py tests/harness/test_schemas.py tests/test_prose.py

.PHONY: run check test test-netem test-ros fuzz compiled docs lint setup clean

run: setup
	$(BIN)/ucp-harness run $(SCENARIO)

check: lint
	$(BIN)/python -m pytest -n 2 -m 'not (lab or docker or uml)' $(ESSENTIAL)

test: setup
	$(BIN)/python -m pytest $(TESTS)

# The tests of real tc netem, inside User Mode Linux: for machines whose kernel lacks sch_netem.
test-netem: setup
	$(BIN)/python -m tests.netem.uml

# The agent that is a ROS 2 node, with ROS from the Python package index in an environment of its own.
test-ros: setup .ros/installed
	$(BIN)/python -m pytest tests/ros

.ros/installed:
	$(PYTHON) -m venv .ros
	.ros/bin/pip install -q --no-compile 'ros-rclpy[fastrtps]' ros-std-msgs
	.ros/bin/pip install -q --no-deps -e .
	@touch $@

# Hostile input for all that reads any, so many seconds for each target: `make fuzz FUZZ_SECONDS=600 TARGETS="agent store"`.
fuzz: setup
	$(BIN)/python -c 'import atheris' 2>/dev/null || $(BIN)/pip install -q -e '.[fuzz]'
	$(BIN)/python -m tests.fuzz --seconds $(FUZZ_SECONDS) $(TARGETS)

# Compiled modules for this clone: docs/how-to/compile-the-harness.md.
compiled: setup
	$(BIN)/pip install -q 'mypy[mypyc]>=2.4' 'setuptools>=65'
	$(BIN)/python -m docs.generate.compiled_modules

# The documentation as a site, in site/index.html.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

lint: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

setup: $(VENV)/installed

$(VENV)/installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)"; exit 3; }
	@PATH="$$PATH:/usr/sbin:/sbin"; \
	needed=""; \
	command -v nft >/dev/null || needed="$$needed nftables"; \
	command -v unshare >/dev/null || needed="$$needed util-linux"; \
	$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || needed="$$needed python3-venv"; \
	if [ -n "$$needed" ]; then \
	  command -v apt-get >/dev/null || { echo "install these first:$$needed"; exit 3; }; \
	  set -x; $(SUDO) apt-get update -q && $(SUDO) apt-get install -q -y $$needed; \
	fi
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --no-compile -e '.[test]'
	@touch $@

clean:
	rm -rf harness/compiled_modules $(VENV) .ros .fuzz .pytest_cache .mypy_cache .ruff_cache .hypothesis
