//! A server under a steady load for a long time.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use seese3_client::proto::v1 as pb;
use seese3_server::Config;
use tokio::time::MissedTickBehavior;

use crate::harness::{TestServer, frame, question, start};

/// How many callers ask at the same time.
const CALLERS: usize = 4;
/// The share of what the server can answer that it is asked.
const LOAD: f64 = 0.8;

/// How long the load lasts: SEESE3_SOAK_SECONDS; `just soak` asks for half an hour.
fn given_time() -> Option<Duration> {
    let given = std::env::var("SEESE3_SOAK_SECONDS").ok()?;
    let seconds = given.parse().expect("SEESE3_SOAK_SECONDS is a number");
    Some(Duration::from_secs_f64(seconds))
}

/// The memory of this process, the server's and the callers', bytes.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:"));
    let number = line.unwrap().split_whitespace().nth(1).unwrap();
    number.parse::<u64>().unwrap() << 10
}

/// One of several questions, in turn.
async fn ask(server: &TestServer, turn: u64) {
    let client = &server.client;
    match turn % 4 {
        0 => {
            let batch = vec![question(); 16];
            assert_eq!(client.batch_navigate(batch).await.unwrap().len(), 16);
        }
        1 => {
            let localize = pb::LocalizeRequest {
                rooms: vec!["synthetic".to_owned()],
                view: frame((turn % 600) as u32),
                ..pb::LocalizeRequest::default()
            };
            assert_eq!(client.localize(localize).await.unwrap().room_count, 1);
        }
        _ => assert!(client.navigate(question()).await.is_ok()),
    }
}

/// Asks at a rate, Hz, or as fast as answers come, and returns the rate that came about.
async fn asked(server: &Arc<TestServer>, during: Duration, rate: Option<f64>) -> f64 {
    let count = Arc::new(AtomicU64::new(0));
    let begun = Instant::now();
    let callers: Vec<_> = (0..CALLERS)
        .map(|_| {
            let (server, count) = (server.clone(), count.clone());

            // A caller that was late does not ask faster after that.
            let mut ticks = rate.map(|rate| {
                let period = Duration::from_secs_f64(CALLERS as f64 / rate);
                let mut ticks = tokio::time::interval(period);
                ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
                ticks
            });
            tokio::spawn(async move {
                // On a slow machine each asks once at least, so that the rate is above 0.
                loop {
                    if let Some(ticks) = &mut ticks {
                        ticks.tick().await;
                    }
                    ask(&server, count.fetch_add(1, Ordering::Relaxed)).await;
                    if begun.elapsed() >= during {
                        break;
                    }
                }
            })
        })
        .collect();

    for caller in callers {
        caller.await.unwrap();
    }
    count.load(Ordering::Relaxed) as f64 / begun.elapsed().as_secs_f64()
}

/// Oracle: the promise: no answer fails, and the memory that the process takes after a fifth of the
/// time is what it takes at the end, within a tenth and 16 MiB. Without a time there are six
/// seconds, and memory is not compared, because other tests share the process.
#[cfg(target_os = "linux")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn memory_is_flat_under_a_steady_load() {
    let server = Arc::new(start(Config::default()).await);
    let time = given_time().unwrap_or(Duration::from_secs(6));
    let most = asked(&server, time / 10, None).await;

    let load = Some(LOAD * most);
    let _ = asked(&server, time / 10, load).await;
    let before = resident_bytes();

    let rate = asked(&server, time * 8 / 10, load).await;
    let after = resident_bytes();
    println!(
        "{rate:.0} of {most:.0} questions a second; {} MiB, then {} MiB",
        before >> 20,
        after >> 20
    );
    assert!(
        given_time().is_none() || after < before + before / 10 + (16 << 20),
        "{before} bytes became {after}"
    );
}
