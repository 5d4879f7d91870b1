//! What every index promises, checked for each.

use ndarray::Array2;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use seese3_core::index::{ExactIndex, Exclusion, Index, JointIndex, PartNeighbor, distance};
#[cfg(feature = "hnsw")]
use seese3_core::index::{HnswIndex, HnswParameters};
use seese3_core::room::FrameId;

type Build = fn(&Array2<f64>, &[FrameId]) -> Box<dyn Index>;

fn exact(latents: &Array2<f64>, frames: &[FrameId]) -> Box<dyn Index> {
    Box::new(ExactIndex::new(latents.view(), frames))
}

#[cfg(feature = "hnsw")]
fn hnsw(latents: &Array2<f64>, frames: &[FrameId]) -> Box<dyn Index> {
    Box::new(HnswIndex::new(
        latents.view(),
        frames,
        HnswParameters::default(),
    ))
}

/// Every index of this build.
fn builds() -> Vec<Build> {
    vec![
        exact,
        #[cfg(feature = "hnsw")]
        hnsw,
    ]
}

fn frames(count: usize) -> Vec<FrameId> {
    (0..count as u32).map(FrameId).collect()
}

fn random(rows: usize, columns: usize, seed: u64) -> Array2<f64> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    Array2::from_shape_simple_fn((rows, columns), || random.random_range(-1.0..1.0))
}

/// A smooth walk in few dimensions bent into many, as latents of a camera's path are.
fn walk(rows: usize) -> Array2<f64> {
    Array2::from_shape_fn((rows, 20), |(row, column)| {
        let t = row as f64 / rows as f64;
        let c = column as f64 + 1.0;
        (t * 9.0 + c).sin() + (t * 23.0 * c / 7.0).cos()
    })
}

/// All frames by distance and then by frame: the definition of the right answer.
fn sorted(latents: &Array2<f64>, frames: &[FrameId], query: &[f64]) -> Vec<(FrameId, f64)> {
    let distance = |frame: &FrameId| {
        latents
            .row(frame.row())
            .iter()
            .zip(query)
            .map(|(a, b)| (a - b).powi(2))
            .sum::<f64>()
            .sqrt()
    };

    let mut all: Vec<(FrameId, f64)> = frames
        .iter()
        .map(|frame| (*frame, distance(frame)))
        .collect();
    all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));

    all
}

/// Checks the contract; `least_recall` is the share of the true k nearest that must be among the k
/// returned.
fn contract(build: Build, least_recall: f64) {
    for (latents, seed) in [
        (walk(900), 1),
        (random(400, 20, 2), 3),
        (random(7, 3, 4), 5),
    ] {
        let all = frames(latents.nrows());
        let index = build(&latents, &all);
        assert_eq!(index.len(), latents.nrows());

        let queries = random(40, latents.ncols(), seed);
        let mut recalls = std::collections::BTreeMap::from([(1, (0, 0)), (10, (0, 0))]);
        for query in queries.outer_iter() {
            let query = query.to_vec();
            let truth = sorted(&latents, &all, &query);
            for k in [1, 10, latents.nrows(), latents.nrows() + 5] {
                let answer = index.nearest(&query, k, None);
                assert_eq!(answer.len(), k.min(latents.nrows()), "k = {k}");
                assert!(answer.is_sorted_by(|a, b| (a.distance, a.frame) < (b.distance, b.frame)));

                for hit in &answer {
                    let expected = truth
                        .iter()
                        .find(|(frame, _)| *frame == hit.frame)
                        .unwrap()
                        .1;

                    assert!(
                        (hit.distance - expected).abs() < 1e-12,
                        "distances are exact in every index"
                    );
                }

                let nearest: Vec<FrameId> = truth.iter().take(k).map(|(frame, _)| *frame).collect();
                if let Some((found, wanted)) = recalls.get_mut(&k) {
                    *found += answer
                        .iter()
                        .filter(|hit| nearest.contains(&hit.frame))
                        .count();

                    *wanted += answer.len();
                }
            }

            let center = truth[0].0;
            let exclusion = Exclusion { center, radius: 2 };
            let kept = index.nearest(&query, 5, Some(exclusion));

            assert!(kept.iter().all(|hit| hit.frame.0.abs_diff(center.0) > 2));

            let left = all
                .iter()
                .filter(|frame| frame.0.abs_diff(center.0) > 2)
                .count();

            assert_eq!(
                kept.len(),
                5.min(left),
                "an exclusion takes nothing from the count"
            );
        }

        for (k, (found, wanted)) in recalls {
            let recall = f64::from(found as u32) / f64::from(wanted as u32);
            assert!(recall >= least_recall, "recall {recall} at k = {k}");
        }
    }
}

/// Frames and distances of the `k` nearest by the definition, with the distance of the library.
fn by_definition(
    latents: &Array2<f64>,
    frames: &[FrameId],
    query: &[f64],
    k: usize,
    exclusion: Option<Exclusion>,
) -> Vec<(FrameId, f64)> {
    let kept = frames
        .iter()
        .filter(|&&frame| !exclusion.is_some_and(|excluded| excluded.covers(frame)));
    let mut all: Vec<(FrameId, f64)> = kept
        .map(|&frame| (frame, distance(&latents.row(frame.row()).to_vec(), query)))
        .collect();
    all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    all.truncate(k);
    all
}

proptest! {
    /// Oracle: the definition, in f64: frames, their order and distances are equal to the bit,
    /// among duplicates, near ties, far from zero, and where f32 overflows or underflows.
    #[test]
    fn the_exact_index_answers_as_a_scan_in_f64(
        seed in 0_u64..1_000,
        rows in 1_usize..400,
        columns in 1_usize..40,
        scale in prop::sample::select(vec![1e-200, 1e-30, 1e-3, 1.0, 1e6, 1e25, 1e150]),
        offset in prop::sample::select(vec![0.0, 1.0, 1e7]),
        noise in prop::sample::select(vec![0.0, 1e-15, 1e-7, 1e-3]),
        k in 0_usize..50,
        radius in prop::option::of(0_u32..30),
        queries in 1_usize..7,
    ) {
        // Some places with several frames each, which differ by the noise.
        let places = random(rows.div_ceil(7), columns, seed);
        let noises = random(rows, columns, seed + 1);
        let latents = Array2::from_shape_fn((rows, columns), |at| {
            let place = places[(at.0 * 31 % places.nrows(), at.1)];
            scale * (offset + place + noise * noises[at])
        });

        // Half of the frames, the last one first.
        let some: Vec<FrameId> = frames(rows).into_iter().rev().filter(|frame| frame.0 % 2 == 0).collect();
        let index = ExactIndex::new(latents.view(), &some);
        let exclusion = radius.map(|radius| Exclusion { center: FrameId((rows / 2) as u32), radius });
        let queries: Vec<Vec<f64>> = (0..queries)
            .map(|query| {
                let between = &latents.row(query % rows) + &latents.row(query * 13 % rows);
                (between * 0.5 + scale * noise).to_vec()
            })
            .collect();

        let slices: Vec<&[f64]> = queries.iter().map(Vec::as_slice).collect();
        let together = index.nearest_of_each(&slices, k, exclusion);
        for (query, together) in queries.iter().zip(together) {
            let found = index.nearest(query, k, exclusion);
            prop_assert_eq!(&found, &together);
            let found: Vec<(FrameId, f64)> = found.iter().map(|hit| (hit.frame, hit.distance)).collect();
            prop_assert_eq!(found, by_definition(&latents, &some, query, k, exclusion));
        }
    }
}

/// Oracle: sorting all distances.
#[test]
fn the_exact_index_keeps_the_contract() {
    contract(exact, 1.0);
}

/// Oracle: as above; an approximate index may miss one nearest frame of a hundred, at every k.
#[cfg(feature = "hnsw")]
#[test]
fn the_hnsw_index_keeps_the_contract() {
    contract(hnsw, 0.99);
}

/// Oracle: the definition: equal distances are ordered by frame, even among duplicates of one
/// latent.
#[test]
fn duplicates_are_returned_by_frame() {
    let latents = Array2::from_shape_fn((60, 4), |(row, column)| ((row / 20) * 10 + column) as f64);
    for build in builds() {
        let answer = build(&latents, &frames(60)).nearest(&latents.row(25).to_vec(), 20, None);
        let found: Vec<u32> = answer.iter().map(|hit| hit.frame.0).collect();
        assert_eq!(found, (20..40).collect::<Vec<u32>>());
    }
}

/// Oracle: the contract. Three clumps of identical latents, each larger than a point's links, so
/// that no graph joins them: all frames come back all the same.
#[test]
fn clumps_that_no_graph_joins_are_returned_whole() {
    let latents = Array2::from_shape_fn((900, 4), |(row, column)| {
        ((row / 300) * 1_000 + column) as f64
    });
    for build in builds() {
        let answer = build(&latents, &frames(900)).nearest(&latents.row(450).to_vec(), 900, None);
        let found: Vec<u32> = answer.iter().map(|hit| hit.frame.0).collect();
        let expected: Vec<u32> = (300..600).chain(0..300).chain(600..900).collect();

        assert_eq!(found.len(), 900);
        assert_eq!(found[..300], expected[..300]);
    }
}

/// Oracle: an index over some of the frames can only find those.
#[test]
fn frames_that_are_no_candidates_are_never_found() {
    let latents = walk(100);
    let some: Vec<FrameId> = (80..100).map(FrameId).collect();
    for build in builds() {
        let answer = build(&latents, &some).nearest(&latents.row(3).to_vec(), 50, None);
        assert_eq!(answer.len(), 20);
        assert!(answer.iter().all(|hit| hit.frame.0 >= 80));
    }
}

/// Oracle: a serial build has nothing to differ by.
#[cfg(feature = "hnsw")]
#[test]
fn building_twice_gives_the_same_answers_and_the_audit_tells_a_poor_graph() {
    let latents = random(1_000, 20, 9);
    let build = || HnswIndex::new(latents.view(), &frames(1_000), HnswParameters::default());
    let a = build();
    let b = build();

    for query in random(50, 20, 10).outer_iter() {
        assert_eq!(
            a.nearest(&query.to_vec(), 10, None),
            b.nearest(&query.to_vec(), 10, None)
        );
    }

    let audit = a.audit(10, 5);
    assert_eq!(
        (audit.frame_count, audit.queries, audit.k),
        (1_000, 200, 10)
    );

    assert!(audit.recall > 0.99 && audit.recall <= 1.0, "{audit:?}");

    let poor = HnswParameters {
        search_effort: 1,
        build_effort: 1,
        links: 2,
    };
    let poor = HnswIndex::new(latents.view(), &frames(1_000), poor).audit(1, 5);

    assert!(
        poor.recall < audit.recall,
        "the audit sees a poor graph: {poor:?}"
    );
}

/// Parts of a few rows each, some of them equal to each other, and queries.
fn parts(seed: u64, count: usize) -> (Vec<Array2<f64>>, Vec<Vec<f64>>) {
    let mut random_row = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut parts: Vec<Array2<f64>> = (0..count)
        .map(|part| random(random_row.random_range(0..40), 6, seed + part as u64))
        .collect();
    if count > 2 {
        parts[count - 1] = parts[0].clone();
    }
    let queries = random(8, 6, seed + 1_000)
        .outer_iter()
        .map(|row| row.to_vec())
        .collect();
    (parts, queries)
}

proptest! {
    /// Oracle: the definition: all rows of all parts by distance, then by part, then by row; the
    /// nearest parts are those of the first row of each in that order.
    #[test]
    fn a_joint_index_answers_as_its_parts(seed in 0_u64..1_000, count in 1_usize..60, k in 1_usize..50) {
        let (parts, queries) = parts(seed, count);
        let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
        let index = JointIndex::of(&views).unwrap();

        for query in &queries {
            let mut all: Vec<(f64, usize, u32)> = Vec::new();
            for (number, part) in parts.iter().enumerate() {
                let rows = part.outer_iter().enumerate();
                all.extend(rows.map(|(row, latent)| (distance(&latent.to_vec(), query), number, row as u32)));
            }
            all.sort_by(|a, b| a.partial_cmp(b).unwrap());
            let mut firsts = all.clone();
            let mut seen = std::collections::BTreeSet::new();
            firsts.retain(|(_, part, _)| seen.insert(*part));

            let found = |found: Vec<PartNeighbor>| -> Vec<(f64, usize, u32)> {
                let plain = |found: &PartNeighbor| (found.neighbor.distance, found.part, found.neighbor.frame.0);
                found.iter().map(plain).collect()
            };
            prop_assert_eq!(found(index.nearest(query, k)), &all[..k.min(all.len())]);
            prop_assert_eq!(found(index.nearest_parts(query, k)), &firsts[..k.min(firsts.len())]);
        }
    }
}
