# fingerpost from a fresh clone; `make` alone lists the targets.
#
# Needed beforehand: git, make, Python 3.11 or newer, and Rust. Whatever else is missing is
# installed by the first target that needs it: Debian packages by apt, Python packages into .venv.

VENV := .venv
BIN := $(VENV)/bin
STAMPS := $(VENV)/stamps
# Its tools are large, and no test needs them.
DOCS_VENV := .venv-docs

# rustup installs below the home directory; a bare environment names neither.
export HOME ?= $(shell /usr/bin/getent passwd "$$(/usr/bin/id -u)" | /usr/bin/cut -d: -f6)
export CARGO_HOME ?= $(HOME)/.cargo
export PATH := $(CARGO_HOME)/bin:$(or $(PATH),/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin)

# Cargo, clippy and maturin must build against one and the same interpreter, or each would undo
# the others' work; no other Python environment may shine through.
export VIRTUAL_ENV := $(CURDIR)/$(VENV)
export PYO3_PYTHON := $(CURDIR)/$(BIN)/python
unexport CONDA_PREFIX PYTHONHOME PYTHONPATH
# Tests start hundreds of processes: none need compile every module anew.
unexport PYTHONDONTWRITEBYTECODE
# Tests are built once and run: in one piece they take a quarter of the time.
export CARGO_INCREMENTAL := 0
# What is built here is run from there, whatever else Cargo is configured to do.
export CARGO_TARGET_DIR ?= $(CURDIR)/target
export PIP_QUIET := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

# What `shell` runs does not see the variables exported above.
WITH_PATH := export PATH='$(PATH)';
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
DRAWS := import ctypes, sys; \
	[ctypes.CDLL(name) for name in ("libEGL.so.1", "libGL.so.1") if sys.platform == "linux"]
PYTHON ?= $(shell $(WITH_PATH) for python in python3 python3.11 python3.12 python3.13 python3.14; \
	do $$python -c '$(NEW_ENOUGH)' 2>/dev/null && echo $$python && break; done)
RUST_VERSION := $(shell $(WITH_PATH) sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
RUST_SOURCES := Cargo.toml Cargo.lock \
	$(shell $(WITH_PATH) find crates -name '*.rs' -o -name Cargo.toml)

PYTHON_SOURCES := pyproject.toml $(shell $(WITH_PATH) find python -name '*.py')

# Installs the Debian packages that the shell's variable `missing` lists.
define INSTALL_MISSING
if [ -n "$$missing" ]; then \
		echo "installing the Debian packages $$missing"; \
		root=; [ "$$(id -u)" = 0 ] || root=sudo; \
		$$root apt-get update --quiet=2 && \
		$$root apt-get install --yes --no-install-recommends --quiet=2 $$missing || \
		{ echo "please install $$missing with your system's package manager" >&2; exit 1; }; \
	fi
endef

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

.PHONY: help demo test lint lint-rust lint-python test-rust instructions bench peers docs setup clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-12s  %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

# Where a developer's tools are, the demo shows the working tree; elsewhere nobody needs them.
demo: $(if $(wildcard $(STAMPS)/extension),$(STAMPS)/extension,$(STAMPS)/installed) ## the main job with nothing plugged in: pictures, a table, a summary
	$(BIN)/fingerpost demo

# What Rust's tests need and what Python's need are built apart, and so at one time. A file's tests
# stay in one process: they share footage. Files keep their order: tests of robots, which mostly
# wait, come first and beside one another, and small files come last. With three processes, two
# cores had nothing to do in a fifth of the time.
test: ## every check there is, in both languages
	$(MAKE) --no-print-directory --jobs 2 lint test-rust instructions
	$(BIN)/python -m pytest --numprocesses 5 --dist loadfile --no-loadscope-reorder

lint: lint-rust lint-python ## formats, lints, types, documentation links, stubs

lint-rust: $(STAMPS)/rust $(STAMPS)/python
	cargo fmt --all --check
	cargo clippy --locked --quiet --workspace --all-targets -- --deny warnings
	RUSTDOCFLAGS='--deny warnings' cargo doc --locked --quiet --no-deps

lint-python: $(STAMPS)/extension
	$(BIN)/ruff check --quiet
	$(BIN)/ruff format --check --quiet
	$(BIN)/mypy --no-error-summary
	$(BIN)/stubtest --mypy-config-file pyproject.toml --concise fingerpost._core

# The compiler of documentation's tests would ask a jobserver that is make's alone.
test-rust: lint-rust
	MAKEFLAGS= cargo test --locked --quiet

# Named beside the extension, the core is taken as it was built for it.
instructions: $(STAMPS)/extension ## count those of fixed workloads against benches/instructions.txt
	cargo build --locked --quiet --release --package fingerpost-py --package fingerpost-benches \
		--bin instructions
	$(CARGO_TARGET_DIR)/release/instructions $(if $(RECORD),record)

bench: $(STAMPS)/extension ## speed as ratios to the C limit, a pair from end to end, the loop, stages, the simulated rig
	cargo bench --locked --package fingerpost-benches --bench ratios
	$(BIN)/python benches/bench_pair.py
	$(BIN)/python benches/bench_loop.py
	cargo bench --locked --package fingerpost-benches --bench stages
	$(BIN)/python benches/bench_simulate.py

peers: $(STAMPS)/extension ## other trackers on the same footage, each in an environment of its own
	$(BIN)/python benches/peers

docs: $(DOCS_VENV)/stamp ## the documentation site, into site/
	PYTHONPATH=python $(DOCS_VENV)/bin/python docs/build.py

setup: $(STAMPS)/extension ## .venv with the extension built, and nothing more

clean: ## remove everything that was installed or built here
	rm -rf $(VENV) $(DOCS_VENV) build site target python/fingerpost/_core*.so

# --- what the targets stand on ---------------------------------------------------------------

$(STAMPS)/extension: $(STAMPS)/rust $(STAMPS)/python $(RUST_SOURCES)
	$(BIN)/maturin develop --release --locked --quiet
	@touch $@

# What a user gets from a wheel: the package and what it needs.
$(STAMPS)/installed: $(STAMPS)/rust $(STAMPS)/venv $(RUST_SOURCES) $(PYTHON_SOURCES)
	$(BIN)/python -m pip install .
	@touch $@

$(STAMPS)/python: pyproject.toml $(STAMPS)/venv $(STAMPS)/debian
	$(BIN)/python -m pip install --no-compile --group dev
	@touch $@

$(DOCS_VENV)/stamp: pyproject.toml $(STAMPS)/compiler $(STAMPS)/rust
	$(PYTHON) -m venv $(DOCS_VENV)
	$(DOCS_VENV)/bin/python -m pip install --upgrade 'pip>=25.1'
	$(DOCS_VENV)/bin/python -m pip install --group docs
	@touch $@

$(STAMPS)/venv: $(STAMPS)/compiler
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --upgrade 'pip>=25.1'
	@touch $@

$(STAMPS)/rust: Cargo.toml
	@if ! have=$$(rustc --version 2>/dev/null | cut -d' ' -f2) || \
	    ! printf '%s\n' $(RUST_VERSION) "$$have" | sort --version-sort --check=quiet; then \
		echo "Rust $(RUST_VERSION) or newer is needed (found: $${have:-none}); run" \
			"curl --proto '=https' -sSf https://sh.rustup.rs | sh -s -- -y   and make again" >&2; \
		exit 1; \
	fi
	@mkdir -p $(@D) && touch $@

# Rust links with the C compiler; Debian's Python comes without the module that makes .venv.
$(STAMPS)/compiler:
	@if ! "$(PYTHON)" -c '$(NEW_ENOUGH)' 2>/dev/null; then \
		echo "Python 3.11 or newer is needed; name one with make PYTHON=..." >&2; \
		exit 1; \
	fi
	@missing=; \
	command -v cc >/dev/null || missing="gcc libc6-dev"; \
	$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || missing="$$missing python3-venv"; \
	$(INSTALL_MISSING)
	@mkdir -p $(@D) && touch $@

# For developers: valgrind counts instructions; the simulated robot cell is drawn off the screen, by
# EGL; the operator's page is tested in a browser.
$(STAMPS)/debian: $(STAMPS)/compiler
	@missing=; \
	[ "$$(uname -s)" != Linux ] || command -v valgrind >/dev/null || missing="$$missing valgrind"; \
	[ "$$(uname -s)" != Linux ] || command -v chromium >/dev/null || missing="$$missing chromium"; \
	$(PYTHON) -c '$(DRAWS)' 2>/dev/null || missing="$$missing libegl1 libgl1 libgl1-mesa-dri"; \
	$(INSTALL_MISSING)
	@mkdir -p $(@D) && touch $@
