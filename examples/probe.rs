use rayon::prelude::*;
use seese3::*;
use std::sync::Arc;
fn main() {
    let seed: u64 = std::env::args().nth(1).unwrap().parse().unwrap();
    let n: usize = std::env::args().nth(2).unwrap().parse().unwrap();
    let epochs: usize = std::env::args().nth(3).unwrap().parse().unwrap();
    let range = std::env::args().nth(4).as_deref() == Some("range");
    let t = std::time::Instant::now();
    let scene = studio::Scene::new(seed);
    let path = studio::camera_path(&scene, n, seed);
    for (i, cam) in [
        (0usize, studio::Camera { width: 320, height: 240, field_of_view_rad: 1.309 }),
        (n / 3, studio::Camera { width: 320, height: 240, field_of_view_rad: 1.309 }),
        (2 * n / 3, studio::Camera { width: 320, height: 240, field_of_view_rad: 1.309 }),
    ] {
        let im = studio::render(&scene, cam, &path[i]);
        let mut f = format!("P6\n{} {}\n255\n", im.width, im.height).into_bytes();
        f.extend(&im.bytes);
        std::fs::write(format!("/tmp/probe/s{seed}_{i}.ppm"), f).unwrap();
    }
    println!("big {:?}", t.elapsed());
    let t = std::time::Instant::now();
    let rows: Vec<Vec<f32>> =
        path.par_iter().map(|p| encoder::encode_builtin(&studio::render(&scene, studio::Camera::small(), p))).collect();
    println!("render+encode {:?}", t.elapsed());
    let d = encoder::BUILTIN_DIM;
    let f = features::Features::new(
        encoder::builtin_source("b"),
        ndarray::Array2::from_shape_vec((n, d), rows.concat()).unwrap(),
    )
    .unwrap();
    let room = Arc::new(
        room::Room::new(
            room::RoomId::new("r").unwrap(),
            room::Frames { poses: path.clone(), ..Default::default() },
            Default::default(),
        )
        .unwrap(),
    );
    for stride in [20u32, 40] {
        let t = std::time::Instant::now();
        let preset = if range { adapter::Preset::PaperRange } else { adapter::Preset::PaperBase };
        let pairs = preset.plan(stride).pairs(pairs::Split::Time, n, 0).unwrap();
        let tw: Vec<_> =
            pairs.iter().map(|p| geometry::body_twist(&path[p.source.row()], &path[p.target.row()])).collect();
        let s = adapter::Samples::new(f.rows(), pairs.iter().map(|p| [p.source.row(), p.target.row()]).collect(), &tw)
            .unwrap();
        let net = adapter::train(&s, &adapter::TrainConfig { epochs, ..preset.config(0) }, &mut |_| ()).unwrap();
        println!("train {:?}", t.elapsed());
        let a = Arc::new(adapter::Adapter::new(f.source().clone(), net, s.scale().clone()).unwrap());
        let nav = navigation::Navigator::new(room.clone(), &f, a.clone(), navigation::IndexKind::Exact).unwrap();
        let tp = pairs::Split::Time.test_pairs(n, stride).unwrap();
        let truth: Vec<_> =
            tp.iter().map(|p| geometry::body_twist(&path[p.source.row()], &path[p.target.row()])).collect();
        let pred: Vec<_> =
            tp.iter().map(|p| a.motion(nav.latents().row(p.source.row()), nav.latents().row(p.target.row()))).collect();
        println!("stride {stride} test {:?}", scores::MotionScores::of(&truth, &pred));
        let rep = eval::evaluate(&nav, &eval::Protocol::paper(stride), &Default::default(), &mut |_, _| ()).unwrap();
        for r in rep.rows {
            println!(
                "{:30} n {} {:?}",
                r.name,
                r.n,
                r.retrieval
                    .hits
                    .iter()
                    .map(|(e, h)| format!("{e}: {:.3} [{:.3},{:.3}]", h.rate, h.low, h.high))
                    .collect::<Vec<_>>()
            );
        }
    }
}
