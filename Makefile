# make fit    film the embedded capture and fit an avatar to it        make fit ARGUMENTS="--config default training.iterations 2000"
# make test   the test suite                                           make test ARGUMENTS="tests/body -m ''"
#
# Both set up first: a virtual environment in .venv, the packages, LLVM. Each step leaves a stamp in .venv, so that it runs once.
# CONSTRAINTS= leaves the pinned versions out (see constraints.txt); PYTHON=... names the interpreter to build .venv from.

SHELL := /bin/bash
VENV := .venv
CONSTRAINTS ?= constraints.txt
ARGUMENTS ?=

# The first interpreter that is new enough and can make virtual environments (Debian packages the latter apart).
CAN_MAKE_VENV := import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 10))
PYTHON ?= $(shell for name in python3 python3.13 python3.12 python3.11 python3.10 python; do \
    if $$name -c '$(CAN_MAKE_VENV)' 2>/dev/null; then echo $$name; break; fi; done)

# Says nothing and succeeds where libLLVM is new enough, or where a GPU makes it unnecessary; otherwise says how to install it.
CHECK_LLVM := $(VENV)/bin/python -c 'import sys; from mitsuba_avatar.rendering import backend; llvm = backend.find_llvm(); \
    sys.exit(None if (llvm and llvm.major >= backend.MINIMUM_LLVM) or backend.cuda_driver_found() else backend.llvm_advice())'

.PHONY: fit test set-up clean

fit: set-up
	$(VENV)/bin/python -m mitsuba_avatar.fit $(ARGUMENTS)

test: set-up
	$(VENV)/bin/python -m pytest $(ARGUMENTS)

set-up: $(VENV)/llvm.stamp

clean:
	rm -rf $(VENV)

$(VENV)/python.stamp:
	@[ -n "$(PYTHON)" ] || { echo "make: expected Python 3.10 or newer with venv; found none. Install it (Debian, Ubuntu: apt-get install python3-venv) or name one: make PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/packages.stamp: $(VENV)/python.stamp pyproject.toml $(CONSTRAINTS)
	$(VENV)/bin/python -m pip install $(if $(CONSTRAINTS),-c $(CONSTRAINTS)) -e '.[dev]'
	@touch $@

$(VENV)/llvm.stamp: $(VENV)/packages.stamp
	@if ! $(CHECK_LLVM) 2>/dev/null && command -v apt-get >/dev/null; then \
	    if [ "$$(id -u)" = 0 ]; then as_root=; else as_root=sudo; fi; \
	    $$as_root apt-get update -q && $$as_root apt-get install -yq libllvm19; \
	fi; \
	$(CHECK_LLVM)
	@touch $@
