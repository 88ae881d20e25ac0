# Each target creates .venv and installs what it needs: a Rust toolchain and Python are enough.
PYTHON ?= python3
BIN := .venv/bin
PROFILE ?= release
SOURCES := $(shell find rust python -name '*.rs' -o -name '*.py') Cargo.toml Cargo.lock pyproject.toml

.PHONY: demo test bench figures docs lint audit build clean

demo: build
	$(BIN)/equipix demo --force

test: PROFILE = ci
test: build
	cargo test --locked
	$(BIN)/python -m pytest -n 2 --dist worksteal

bench: build
	$(BIN)/python benches/run.py

figures: build
	$(BIN)/python docs/figures.py

docs:
	RUSTDOCFLAGS="-D warnings" cargo doc --locked --no-deps -p equipix-core

lint: PROFILE = ci
lint: build docs
	cargo fmt --all --check
	cargo clippy --locked --workspace --all-targets -- -D warnings
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m mypy.stubtest equipix._native
	find python/equipix -name '*.py' | xargs $(BIN)/numpydoc lint

audit:
	@if command -v cargo-deny; then cargo deny --locked check; \
	else echo "no cargo-deny: cargo install --locked cargo-deny"; fi
	@if command -v pip-audit; then pip-audit -r requirements-dev.txt; \
	else echo "no pip-audit: pipx install pip-audit"; fi

build: $(BIN)/.built-$(PROFILE)

$(BIN)/.installed: requirements-dev.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.txt
	touch $@

$(BIN)/.built-$(PROFILE): $(BIN)/.installed $(SOURCES)
	$(BIN)/maturin develop --locked --profile $(PROFILE) --extras plot,codecs
	rm -f $(BIN)/.built-*
	touch $@

clean:
	rm -rf .venv target demo
