# `just check` is the developer's habit and all of CI.

check: test lint doc e2e

test:
    cargo test

# Formatting, warnings, protos, deployment files.
lint:
    cargo fmt --check
    cargo clippy --all-targets -- -D warnings
    buf lint proto
    hadolint deploy/Dockerfile
    .ci/lint-unit

doc:
    RUSTDOCFLAGS="-D warnings" cargo doc --no-deps

# The demo and, where the folder of large inputs is, the real room, as a user runs them.
e2e:
    .ci/end-to-end

bench:
    cargo bench

# Makes the expected values of tests/golden again; needs the packages of tests/golden/requirements.txt.
golden:
    bash tests/golden/make_all.sh python3

serve store:
    cargo run --release -- serve --store {{store}}
