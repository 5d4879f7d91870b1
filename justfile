# `just check` is the developer's habit and all of CI.

check: test lean lint doc hygiene e2e

test:
    cargo test --workspace --features full

# The tests that need the folder of large inputs, SEESE3_SHARED or ../shared.
large:
    cargo test --workspace --features full -- --ignored

# The long form of what the tests show in short: a thousand reloads under load.
soak:
    SEESE3_RELOADS=1000 cargo test --release --test service swapped

# What differs without the features: a model is answered with the line that builds them in; and the server builds without
# the laboratory.
lean:
    cargo test --test commands rooms::
    cargo check --no-default-features

# Formatting, warnings, protos, deployment files.
lint:
    cargo fmt --check
    cargo clippy --workspace --all-targets -- -D warnings
    cargo clippy --workspace --all-targets --features full -- -D warnings
    buf lint proto
    hadolint deploy/Dockerfile
    .ci/lint-unit

doc:
    RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps --features full

# Licences and sources of dependencies, dependencies that nothing uses, typing errors.
hygiene:
    .ci/licenses
    cargo machete
    typos

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
