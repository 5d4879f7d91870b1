//! Publishers and servers that are killed at any moment: the store always opens at an old or at a
//! new revision, and is clean once its garbage is collected.

use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use seese3_testing::{features, golden};

use crate::program::Place;

/// How often each is killed: SEESE3_KILLS, 8 if it is not set; `just kills` asks for 200.
fn kills() -> u32 {
    let given = std::env::var("SEESE3_KILLS").ok();
    given.map_or(8, |count| count.parse().expect("SEESE3_KILLS is a number"))
}

/// The arguments that publish room `a` in a store; its features differ from those of every other
/// `version`.
pub fn import(here: &Place, version: u32, store: &str) -> String {
    let rows = features(&golden(), "synthetic") * (1.0 + version as f32);
    let file = format!("features-{version}.npy");
    ndarray_npy::write_npy(here.file(&file), &rows).unwrap();

    let poses = "golden/rooms/synthetic/poses.npy";
    format!("import numpy --name a --poses {poses} --features f={file} --store {store}")
}

/// The revision that the room has now, after `store verify` found nothing wrong.
fn intact_revision(here: &Place) -> u64 {
    here.prints("store verify --store store", &["everything can be read"]);

    let shown = here.succeeds("store show rooms/a --json --store store");
    let shown: serde_json::Value = serde_json::from_str(&shown).unwrap();
    shown["current"].as_u64().unwrap()
}

/// Calls `round` with a version and the time after which to kill, at least [`kills`] times: after
/// each round the store is intact, and has one new revision or none.
///
/// The times are drawn from a range that grows when the work was cut short and shrinks when it was
/// finished, so that both happen however busy the machine is. The rounds go on until both have.
fn killed_at_any_moment(here: &Place, mut longest: Duration, mut round: impl FnMut(u32, Duration)) {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut before = intact_revision(here);
    let mut version = 0;
    let (mut finished, mut cut_short) = (0, 0);

    while version < kills() || finished == 0 || cut_short == 0 {
        version += 1;
        assert!(
            version < kills() + 100,
            "{finished} were finished, {cut_short} cut short"
        );
        round(version, longest.mul_f64(random.random_range(0.0..1.0)));

        let now = intact_revision(here);
        assert!(now == before || now == before + 1, "{before} became {now}");
        let was_finished = now > before;
        finished += u32::from(was_finished);
        cut_short += u32::from(!was_finished);
        longest = longest.mul_f64(if was_finished { 0.7 } else { 1.4 });
        before = now;

        here.succeeds("store gc --older-than 0 --no-concurrent-publishers --store store");
        assert_eq!(intact_revision(here), now);
    }
}

/// Oracle: the promise of the store.
#[test]
fn a_publisher_that_is_killed_leaves_an_old_or_a_new_revision() {
    let here = Place::new();
    let first = import(&here, 0, "store");
    let began = Instant::now();
    here.succeeds(&first);

    killed_at_any_moment(&here, began.elapsed() * 2, |version, moment| {
        let mut publisher = here.start(&import(&here, version, "store"));
        std::thread::sleep(moment);
        publisher.kill();
    });
}

/// Oracle: the promise of uploads: all of one or nothing.
#[test]
fn a_server_that_is_killed_during_an_upload_leaves_an_old_or_a_new_revision() {
    let here = Place::new();
    for store in ["store", "source"] {
        here.succeeds(&import(&here, 0, store));
    }

    // How long an upload takes that nobody kills.
    let push = "push rooms/a --replace --store source --server";
    let mut server = here.serve("--writable");
    let began = Instant::now();
    here.succeeds(&format!("{push} {}", server.address));
    let longest = began.elapsed() * 2;
    server.kill();

    killed_at_any_moment(&here, longest, |version, moment| {
        here.succeeds(&import(&here, version, "source"));

        let mut server = here.serve("--writable");
        let mut push = here.start(&format!("{push} {}", server.address));
        std::thread::sleep(moment);
        server.kill();
        push.process.wait().unwrap();
    });
}
