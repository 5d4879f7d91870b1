//! The relational reader from training to the answers of a server.

use seese3_testing::number;

use crate::program::Place;

/// Oracle: the contract: the reader is trained, stored, evaluated beside the others and served;
/// what has no cells is refused.
#[test]
fn a_relational_reader_is_trained_evaluated_and_served() {
    let here = Place::new();
    here.succeeds("studio --store store --rooms 3 --frames 60 --seed 3");

    let rooms = "--room studio3-0000 --room studio3-0001";
    let fixed =
        format!("train --store store {rooms} --split whole --stride 10 --epochs 1 --name eyes");
    let trained =
        format!("{fixed} --reader relational --reader-epochs 1 --calibrate-on studio3-0002");
    here.prints(
        &trained,
        &["relational reader", "adapter 'eyes' revision 1"],
    );

    // Another room than the calibration room would be held out; here only the row matters.
    let evaluate =
        "evaluate --store store --room studio3-0002 --adapter eyes --split whole --stride 10";
    here.prints(&format!("{evaluate} --json found.json"), &["relational"]);
    let found = here.json("found.json");
    let rows = found["navigators"].as_array().unwrap();
    let row = rows.iter().find(|row| row["name"] == "relational").unwrap();
    let rate = number(&row["hit"]["0.1"]["rate"]);
    assert!((0.0..=1.0).contains(&rate), "{row}");

    // Alone, its row still has a difference from Identity.
    here.succeeds(&format!(
        "{evaluate} --navigators relational --json alone.json"
    ));
    let alone = here.json("alone.json");
    assert_eq!(
        alone["navigators"][0]["hit_over_identity"],
        row["hit_over_identity"]
    );
    here.prints(
        "store show --store store adapters/eyes",
        &["with a relational reader"],
    );

    // A shortlist of one is what inverse Poincaré retrieves.
    here.succeeds(&format!("{evaluate} --shortlist 1 --json one.json"));
    let found = here.json("one.json");
    let rows = found["navigators"].as_array().unwrap();
    let hits = |name: &str| rows.iter().find(|row| row["name"] == name).unwrap()["hit"].clone();
    assert_eq!(hits("relational"), hits("inverse-poincare-homogeneous"));

    let motion =
        "evaluate motion --store store --room studio3-0002 --adapter eyes --json motion.json";
    here.prints(
        motion,
        &[
            "its relational reader",
            "no motion",
            "the relational reader gave all motions; ",
        ],
    );
    let found = here.json("motion.json");
    assert_eq!(
        found["relational"]["components"].as_array().unwrap().len(),
        6
    );

    let server = here.serve("");
    let to = format!(
        "--server {} --room studio3-0002 --adapter eyes",
        server.address
    );
    here.prints(
        &format!("motion {to} --from 1 --to 11 --relational"),
        &["relational reader of adapter", "standard deviation"],
    );
    let navigate = format!("navigate {to} --from 1 --to 11 --navigator relational");
    here.prints(&navigate, &["relational", "negative log-densities"]);
    here.prints(
        &format!("catalog --server {}", server.address),
        &[", relational reader"],
    );
}

/// Oracle: the contract: features that are no grid, and names that are not there.
#[test]
fn features_without_cells_train_no_reader() {
    let here = Place::new();
    here.succeeds(&Place::import("r", "synthetic"));
    let train = "train --store store --room r --epochs 1";
    here.refuses(
        &format!("{train} --reader relational"),
        &["'fourier'", "grid"],
    );
    here.refuses(&format!("{train} --features fourier,other"), &["'other'"]);
    here.refuses(
        &format!("{train} --features fourier,fourier"),
        &["'fourier' are given twice"],
    );
    here.succeeds(&format!("{train} --name plain"));
    here.refuses(
        "evaluate --store store --room r --adapter plain --navigators relational",
        &["adapter 'plain' has no relational reader"],
    );

    let cross = "cross-room --store store --train r --test r2 --navigators relational";
    here.succeeds(&Place::import("r2", "synthetic_b"));
    here.refuses(cross, &["--reader relational"]);
}
