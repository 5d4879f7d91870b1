# `just check` is the developer's habit and all of CI.

check: test lean lint doc e2e

test:
    cargo test --features full

# What differs without the features: a model is answered with the line that builds them in.
lean:
    cargo test --test cli_rooms --test encoders

# Formatting, warnings, protos, deployment files.
lint:
    cargo fmt --check
    cargo clippy --all-targets -- -D warnings
    cargo clippy --all-targets --features full -- -D warnings
    buf lint proto
    hadolint deploy/Dockerfile
    .ci/lint-unit

doc:
    RUSTDOCFLAGS="-D warnings" cargo doc --no-deps --features full

# The demo and, where the folder of large inputs is, the real room, as a user runs them.
e2e:
    .ci/end-to-end

bench:
    cargo bench --features full

# Makes the expected values of tests/golden again; needs the packages of tests/golden/requirements.txt.
golden:
    bash tests/golden/make_all.sh python3

serve store:
    cargo run --release -- serve --store {{store}}
