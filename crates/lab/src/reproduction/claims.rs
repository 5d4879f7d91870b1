//! Verdicts on the paper's claims, and on ours, from the given rooms.
//!
//! A claim is tested in several cases, such as feature sets or strides. A case is a mean over rooms
//! that is above zero where the claim holds. [`judge`] corrects the tests of all claims together,
//! and only then decides.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use seese3_core::statistics::{
    CrossedMean, RoomMean, bootstrap_mean, crossed_mean, holm, mean, mean_of_known, sign_flip_p,
};

use crate::experiments::cross_room::clipped_r2;
use crate::report::Column::{self, Text};
use crate::report::{Section, Table, room_difference_text};

/// Largest adjusted p-value with which a case counts as decided.
const SIGNIFICANCE: f64 = 0.05;

/// A claim and the evidence found for or against it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Claim {
    /// The claim, one sentence.
    pub claim: String,
    /// The quantity of each room whose mean is tested: above zero where the claim holds.
    pub tested: String,
    /// Whether these rooms confirm it; [`Verdict::Untested`] until all claims are judged together.
    #[serde(serialize_with = "word", deserialize_with = "of_word")]
    pub verdict: Verdict,
    /// The cases in which it was tested.
    pub cases: Vec<Case>,
}

/// A test of a claim in one case.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Case {
    /// The feature set, the stride or the alternative.
    pub case: String,
    /// The mean over rooms with its 95 % interval, not corrected for the number of tests; `None`
    /// without rooms.
    pub mean: Option<RoomMean>,
    /// Number of trainings with different seeds, where their spread is part of the interval.
    pub trainings: Option<usize>,
    /// Two-sided p-value: of the sign-flip test; with several trainings, of Student's t test of a
    /// mean of zero.
    pub p: Option<f64>,
    /// The same with Holm's correction for all tests of the report.
    pub adjusted_p: Option<f64>,
    /// Why the case decides nothing, where it was not tested.
    pub reason: Option<String>,
}

fn word<S: Serializer>(verdict: &Verdict, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(verdict.word())
}

fn of_word<'de, D: Deserializer<'de>>(from: D) -> Result<Verdict, D::Error> {
    let word = String::deserialize(from)?;
    let verdict = Verdict::ALL
        .into_iter()
        .find(|verdict| verdict.word() == word);
    verdict.ok_or_else(|| serde::de::Error::custom(format!("'{word}' is no verdict")))
}

impl Claim {
    /// A claim to be judged. `tested` is the quantity of each room whose mean is above zero where
    /// the claim holds.
    pub fn new(claim: &str, tested: &str, cases: Vec<Case>) -> Self {
        Self {
            claim: claim.to_owned(),
            tested: tested.to_owned(),
            verdict: Verdict::Untested,
            cases,
        }
    }
}

impl Case {
    /// One value per room, with a bootstrap interval and the sign-flip test over the rooms. Rooms
    /// whose value is not finite are left out.
    pub fn of_rooms(case: impl Into<String>, values: &[f64]) -> Self {
        let known: Vec<f64> = values.iter().copied().filter(|x| x.is_finite()).collect();
        if known.is_empty() {
            return Self::untested(case, None, "no room has a value");
        }
        Self {
            case: case.into(),
            mean: Some(bootstrap_mean(&known, 0)),
            trainings: None,
            p: Some(sign_flip_p(&known, 0)),
            adjusted_p: None,
            reason: None,
        }
    }

    /// The differences `ours − theirs`, paired by room.
    pub fn of_difference(case: impl Into<String>, ours: &[f64], theirs: &[f64]) -> Self {
        let differences: Vec<f64> = ours.iter().zip(theirs).map(|(a, b)| a - b).collect();
        Self::of_rooms(case, &differences)
    }

    /// The differences `ours − theirs`, paired by training and room.
    pub fn of_paired_trainings(
        case: impl Into<String>,
        ours: &[Vec<f64>],
        theirs: &[Vec<f64>],
    ) -> Self {
        match &differences(ours, theirs)[..] {
            [alone] => Self::of_rooms(case, alone),
            several => Self::of_trainings(case, several),
        }
    }

    /// A value per training and room, with the spread of both; see [`crossed_mean`]. Rooms with a
    /// value that is not finite are left out.
    pub fn of_trainings(case: impl Into<String>, by_training: &[Vec<f64>]) -> Self {
        let known = known_rooms(by_training);
        let rooms = known.first().map_or(0, Vec::len);
        let Some(crossed) = crossed_mean(&known) else {
            let reason = format!(
                "{} trainings in {rooms} rooms: their spread is unknown",
                known.len()
            );
            return Self::untested(case, Some(&means_of_rooms(&known)), &reason);
        };
        Self {
            case: case.into(),
            mean: Some(room_mean(&crossed, rooms)),
            trainings: Some(by_training.len()),
            p: Some(crossed.p),
            adjusted_p: None,
            reason: None,
        }
    }

    /// A case that decides nothing, with the mean of `values` if there are any.
    pub fn untested(case: impl Into<String>, values: Option<&[f64]>, reason: &str) -> Self {
        let values = values.filter(|values| !values.is_empty());
        Self {
            case: case.into(),
            mean: values.map(|values| bootstrap_mean(values, 0)),
            trainings: None,
            p: None,
            adjusted_p: None,
            reason: Some(reason.to_owned()),
        }
    }

    /// The case without its test, for the given reason.
    pub fn without_test(self, reason: String) -> Self {
        Self {
            p: None,
            reason: Some(reason),
            ..self
        }
    }

    /// Whether the claim holds in this case; `None` if the test does not decide.
    fn holds(&self) -> Option<bool> {
        let is_decided = self.adjusted_p? < SIGNIFICANCE;
        is_decided.then_some(self.mean?.mean > 0.0)
    }
}

/// The differences `ours − theirs`, paired by training and room.
pub fn differences(ours: &[Vec<f64>], theirs: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let of_training = |(ours, theirs): (&Vec<f64>, &Vec<f64>)| {
        ours.iter().zip(theirs).map(|(a, b)| a - b).collect()
    };
    ours.iter().zip(theirs).map(of_training).collect()
}

/// The mean over trainings and rooms with the spread of both; of one training, or where the spread
/// is unknown, with that of the rooms alone. Rooms with a value that is not finite are left out.
pub fn mean_over_trainings(by_training: &[Vec<f64>]) -> RoomMean {
    let known = known_rooms(by_training);
    let rooms = means_of_rooms(&known);
    match crossed_mean(&known) {
        Some(crossed) => room_mean(&crossed, rooms.len()),
        None => bootstrap_mean(&rooms, 0),
    }
}

/// The values of the rooms in which every training has a finite one.
fn known_rooms(by_training: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let all = by_training.iter().map(Vec::len).min().unwrap_or(0);
    let is_known = |&room: &usize| by_training.iter().all(|values| values[room].is_finite());
    let known: Vec<usize> = (0..all).filter(is_known).collect();
    let of_known = |values: &Vec<f64>| known.iter().map(|&room| values[room]).collect();
    by_training.iter().map(of_known).collect()
}

/// The mean over trainings for each room.
fn means_of_rooms(by_training: &[Vec<f64>]) -> Vec<f64> {
    let rooms = by_training.first().map_or(0, Vec::len);
    let of_room = |room: usize| {
        let values: Vec<f64> = by_training.iter().map(|values| values[room]).collect();
        mean(&values)
    };
    (0..rooms).map(of_room).collect()
}

/// max(R², −1) of each room's mean over seeds. A seed without a value is left out.
pub fn clipped_means(by_seed: &[Vec<f64>]) -> Vec<f64> {
    let rooms = by_seed.first().map_or(0, Vec::len);
    let of_room = |room: usize| {
        let of_seeds: Vec<f64> = by_seed.iter().map(|rooms| rooms[room]).collect();
        clipped_r2(mean_of_known(&of_seeds))
    };
    (0..rooms).map(of_room).collect()
}

fn room_mean(crossed: &CrossedMean, rooms: usize) -> RoomMean {
    RoomMean {
        mean: crossed.mean,
        low: crossed.low,
        high: crossed.high,
        rooms,
    }
}

/// The outcome of testing a claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// The claim holds in every case.
    Confirmed,
    /// The claim fails in every case.
    Contradicted,
    /// Some cases are decided, but not all, or they disagree.
    Mixed,
    /// No case is decided.
    Open,
    /// There is no case to test the claim on.
    Untested,
}

impl Verdict {
    /// Every verdict.
    const ALL: [Self; 5] = [
        Self::Confirmed,
        Self::Contradicted,
        Self::Mixed,
        Self::Open,
        Self::Untested,
    ];

    /// The verdict over cases; `None` is an undecided case.
    fn of(cases: &[Option<bool>]) -> Self {
        let all_are = |outcome: Option<bool>| cases.iter().all(|&case| case == outcome);
        if cases.is_empty() {
            Self::Untested
        } else if all_are(None) {
            Self::Open
        } else if all_are(Some(true)) {
            Self::Confirmed
        } else if all_are(Some(false)) {
            Self::Contradicted
        } else {
            Self::Mixed
        }
    }

    fn word(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::Contradicted => "contradicted",
            Self::Mixed => "mixed",
            Self::Open => "open",
            Self::Untested => "not tested",
        }
    }
}

/// The feature sets, or their results, of trained encoders, and the control: the last one of
/// several.
pub fn encoders_and_control<T>(sets: &[T]) -> (&[T], Option<&T>) {
    match sets {
        [encoders @ .., control] if !encoders.is_empty() => (encoders, Some(control)),
        all => (all, None),
    }
}

/// Decides all claims of a report: adjusts the p-values of all their cases together by Holm's
/// method.
pub fn judge(claims: &mut [Claim]) {
    let all = claims.iter().flat_map(|claim| &claim.cases);
    let p_values: Vec<f64> = all.filter_map(|case| case.p).collect();
    let mut adjusted = holm(&p_values).into_iter();

    for claim in claims {
        for case in &mut claim.cases {
            case.adjusted_p = case.p.and_then(|_| adjusted.next());
        }
        let holds: Vec<Option<bool>> = claim.cases.iter().map(Case::holds).collect();
        claim.verdict = Verdict::of(&holds);
    }
}

/// The table of claims, and the table of their tests. [`judge`] decided the claims.
pub fn section(claims: &[Claim]) -> Section {
    let mut section = Section::new("The paper's claims in these rooms");

    let columns: [Column<(usize, &Claim)>; 5] = [
        Text("claim", |(_, claim)| claim.claim.clone()),
        Text("here", |(_, claim)| claim.verdict.word().to_owned()),
        Text("cases", |(_, claim)| counts(claim)),
        Text("quantity, above 0 if the claim holds", |(_, claim)| {
            claim.tested.clone()
        }),
        Text("tests", |(number, _)| number.to_string()),
    ];
    let numbered: Vec<(usize, &Claim)> = (1..).zip(claims).collect();
    section.table(Table::of(&numbered, &columns));

    let tests = claims.iter().flat_map(|claim| &claim.cases);
    let count = tests.filter(|case| case.p.is_some()).count();
    section.text(format!(
        "The {count} tests. Means over rooms with 95 % intervals, not corrected; p is of the sign-flip test over rooms, or, \
         with several trainings, of Student's t with the spread of rooms and trainings. A case is decided where p, by \
         Holm's correction for all {count} tests, is below {SIGNIFICANCE}. A claim is confirmed if it holds in every case, \
         contradicted if it fails in every case, open if no case is decided, and mixed otherwise."
    ));
    section.table(tests_table(claims));
    section
}

/// How many cases of a claim hold, fail and are open, in words.
fn counts(claim: &Claim) -> String {
    let of = |outcome: Option<bool>| {
        let cases = claim.cases.iter();
        cases.filter(|case| case.holds() == outcome).count()
    };
    let parts = [
        (of(Some(true)), "holds"),
        (of(Some(false)), "fails"),
        (of(None), "open"),
    ];
    let words = parts
        .iter()
        .filter(|(count, _)| *count > 0)
        .map(|(count, word)| format!("{word} in {count}"));
    words.collect::<Vec<_>>().join(", ")
}

fn tests_table(claims: &[Claim]) -> Table {
    let mut table =
        Table::new("test of claim | case | rooms | trainings | mean [95 %] | p | p, corrected");
    for (number, claim) in (1..).zip(claims) {
        for case in &claim.cases {
            let p = case.p.map(p_text);
            let adjusted = case.adjusted_p.map(p_text);
            let cells = [
                case.case.clone(),
                case.mean
                    .map_or(String::new(), |mean| mean.rooms.to_string()),
                case.trainings
                    .map_or(String::new(), |trainings| trainings.to_string()),
                case.mean
                    .map_or(String::new(), |mean| room_difference_text(&mean)),
                p.or_else(|| case.reason.clone()).unwrap_or_default(),
                adjusted.unwrap_or_default(),
            ];
            table.row(number.to_string(), cells);
        }
    }
    table
}

fn p_text(p: f64) -> String {
    if p < 0.001 {
        "< 0.001".to_owned()
    } else {
        format!("{p:.3}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn claim(cases: Vec<Case>) -> Claim {
        Claim::new("c", "t", cases)
    }

    /// Oracle: by hand. Sixteen rooms of one sign decide a case even after the correction for four
    /// tests (2⁻¹⁵ · 4), four rooms do not (2⁻³ = 0.125), and six rooms do alone (2⁻⁵ = 0.031) but
    /// not among four tests.
    #[test]
    fn tests_are_corrected_over_all_claims() {
        let high = |rooms: usize| Case::of_rooms("x", &vec![0.3; rooms]);
        let low = Case::of_rooms("x", &[-0.3; 16]);

        let mut alone = [claim(vec![high(6)])];
        judge(&mut alone);
        assert_eq!(alone[0].verdict, Verdict::Confirmed);

        let mut claims = [
            claim(vec![high(16)]),
            claim(vec![low, high(4)]),
            claim(vec![high(6)]),
        ];
        judge(&mut claims);
        let verdicts = claims.each_ref().map(|claim| claim.verdict);
        assert_eq!(
            verdicts,
            [Verdict::Confirmed, Verdict::Mixed, Verdict::Open]
        );
    }

    /// Oracle: the meaning of the words.
    #[test]
    fn a_verdict_says_whether_all_cases_agree() {
        let word = |cases: &[Option<bool>]| Verdict::of(cases).word();
        assert_eq!(word(&[Some(true), Some(true)]), "confirmed");
        assert_eq!(word(&[Some(false), Some(false)]), "contradicted");
        assert_eq!(word(&[Some(false), Some(true)]), "mixed");
        assert_eq!(word(&[Some(true), None]), "mixed");
        assert_eq!(word(&[None, None]), "open");
        assert_eq!(word(&[]), "not tested");
    }

    /// Oracle: one training has no spread, and an untested case has no p-value.
    #[test]
    fn a_case_without_a_test_decides_nothing() {
        let one = Case::of_trainings("x", &[vec![0.5; 30]]);
        let none = Case::of_rooms("x", &[f64::NAN]);
        let few = Case::of_rooms("x", &[0.5; 30]).without_test("too few seeds".to_owned());
        let mut claims = [claim(vec![one, none, few])];
        judge(&mut claims);

        assert_eq!(claims[0].verdict, Verdict::Open);
        assert!(claims[0].cases.iter().all(|case| case.reason.is_some()));
    }

    /// Oracle: by hand: the mean is clipped, not the seeds, and an unknown seed is left out.
    #[test]
    fn seeds_are_averaged_before_they_are_clipped() {
        let by_seed = [vec![0.5, -3.0, f64::NAN], vec![0.25, 2.0, 0.5]];
        assert_eq!(clipped_means(&by_seed), [0.375, -0.5, 0.5]);
        assert_eq!(clipped_means(&[vec![-4.0]]), [-1.0]);
    }

    /// Oracle: by hand, and for one training the bootstrap over rooms.
    #[test]
    fn differences_are_paired_by_training_and_room() {
        let ours = [vec![0.5, 0.7], vec![0.4, 0.6]];
        let theirs = [vec![0.25, 0.5], vec![0.4, 0.5]];
        let found = differences(&ours, &theirs);
        let expected = [[0.25, 0.2], [0.0, 0.1]];
        for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }

        let both = mean_over_trainings(&found);
        assert!((both.mean - 0.1375).abs() < 1e-12);
        assert_eq!(both.rooms, 2);
        assert_eq!(
            mean_over_trainings(&found[..1]),
            bootstrap_mean(&found[0], 0)
        );
        let case = Case::of_paired_trainings("x", &ours, &theirs);
        assert_eq!((case.trainings, case.mean), (Some(2), Some(both)));
        let case = Case::of_paired_trainings("x", &ours[..1], &theirs[..1]);
        assert_eq!(case.trainings, None);
    }
}
