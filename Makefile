# Lookalike: two commands do everything on a fresh Debian 12 with a Rust toolchain.
#   make demo [MODEL=path]   build, start a server, simplify a model, leave the results in out/demo
#   make test                everything that CI checks
.PHONY: demo test setup build lint deny unit python loadtest farm torture bench results viewers advisories

CARGO ?= cargo
VENV := .venv
# What the installed client is made of, the protos apart.
CLIENT := $(wildcard clients/python/*.py clients/python/*.toml clients/python/src/lookalike/*)

demo: build
	deploy/demo.sh $(MODEL)

build:
	deploy/setup.sh
	$(CARGO) build --release --bins

test: lint deny unit python
	@echo "all checks passed"

lint:
	deploy/setup.sh test
	$(CARGO) fmt --check
	$(CARGO) clippy --release --all-targets -- -D warnings

# Licences, banned crates and sources of all dependencies (deny.toml); needs no network.
deny:
	@if $(CARGO) deny --version >/dev/null 2>&1; then \
	    $(CARGO) deny --log-level error check licenses bans sources; \
	else \
	    echo "deny: SKIPPED, cargo-deny is not installed (cargo install --locked cargo-deny)"; \
	fi

unit:
	deploy/setup.sh test
	INSTA_CI=1 $(CARGO) test --release

# The program as `unit` builds it: dev-dependencies change features of dependencies, and without them
# all would be compiled again.
python: $(VENV)/installed
	deploy/setup.sh test
	$(CARGO) test --release --no-run
	LOOKALIKE_BIN=$(CURDIR)/target/release/lookalike $(VENV)/bin/python -m pytest -q clients/python/tests
	LOOKALIKE_BIN=$(CURDIR)/target/release/lookalike $(VENV)/bin/python -m pytest -q loadtest
	LOOKALIKE_PYTHON=$(CURDIR)/$(VENV)/bin/python \
	    $(CARGO) test --release --test service -- chaos_between_python

$(VENV)/installed: $(CLIENT) $(wildcard proto/lookalike/*/*.proto)
	deploy/setup.sh test
	python3 -m venv $(VENV)
	$(VENV)/bin/pip install -q './clients/python[test]'
	touch $@

# What the service bears, on both pairs of stores, beside pgbench: into docs/results.md. Nothing else should run
# on the machine; if something does, NOTE="..." says so there.
loadtest:
	deploy/setup.sh test
	$(CARGO) test --release --test load -- --full --write docs/results.md $(if $(NOTE),--note "$(NOTE)")

# Many whole jobs at once, every result checked.
farm: build $(VENV)/installed
	$(VENV)/bin/python loadtest/farm.py --binary target/release/lookalike --jobs 40 --in-flight 8

# Kills and freezes processes at random moments, on both pairs of stores; the long mode is ROUNDS=200.
# A run is repeated by the seed that it prints: SEED=...
torture:
	deploy/setup.sh test
	LOOKALIKE_TORTURE_ROUNDS=$(or $(ROUNDS),20) $(if $(SEED),LOOKALIKE_TORTURE_SEED=$(SEED)) \
	    $(CARGO) test --release --test service -- torture_of --nocapture

bench:
	$(CARGO) bench

# docs/results.md and its pictures, anew (QUICK=1 leaves the long runs out; JOBS=8 runs beside one another, two cores each).
results: build
	python3 benches/results.py $(if $(QUICK),--quick) $(if $(JOBS),--jobs $(JOBS))

# What the Khronos validator, three.js and Blender say of the files: into docs/results.md. Needs node, Python 3.11 (for
# Blender's package) and, the first time, the network; so it is not part of `make test`.
viewers: build
	cd benches/viewers && npm ci --silent
	python3.11 -m venv benches/viewers/.venv
	benches/viewers/.venv/bin/pip install -q -r benches/viewers/requirements.txt
	benches/viewers/.venv/bin/python benches/viewers/viewers.py

# Known vulnerabilities and yanked versions: asks the network, and so is not part of `make test`.
advisories:
	$(CARGO) deny check advisories
