//! Verdicts on the paper's claims, and on ours, from the given rooms.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use seese3_core::statistics::{Rate, RoomMean};

use crate::report::Column::{self, Text};
use crate::report::{Section, Table};

/// A claim and the evidence found for or against it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Claim {
    /// The claim, one sentence.
    pub claim: String,
    /// Whether these rooms confirm it.
    #[serde(serialize_with = "word", deserialize_with = "of_word")]
    pub verdict: Verdict,
    /// The evidence for the verdict, in words.
    pub found: String,
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
    /// A claim decided by one confidence interval per feature set; see [`Verdict::of_intervals`].
    /// `criterion` says when it holds for a feature set.
    pub fn over_feature_sets(claim: &'static str, criterion: &str, cases: &[Option<bool>]) -> Self {
        Self {
            claim: claim.to_owned(),
            verdict: Verdict::of_intervals(cases),
            found: format!("{criterion}: {}", count_words(cases, "feature sets")),
        }
    }
}

/// The outcome of testing a claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// The claim holds in every case.
    Confirmed,
    /// The claim holds in no case.
    Contradicted,
    /// The claim holds for some feature sets or rooms and not for others.
    Mixed,
    /// No case is conclusive: the baselines fail there too, or every interval contains the limit.
    CannotTell,
    /// There is no case to test the claim on.
    Untested,
}

impl Verdict {
    /// Every verdict.
    const ALL: [Self; 5] = [
        Self::Confirmed,
        Self::Contradicted,
        Self::Mixed,
        Self::CannotTell,
        Self::Untested,
    ];

    /// Confirmed if the claim holds in every case, contradicted if it holds in no case.
    pub fn of(holds: &[bool]) -> Self {
        let held = holds.iter().filter(|&&holds| holds).count();
        match held {
            _ if holds.is_empty() => Self::Untested,
            0 => Self::Contradicted,
            count if count == holds.len() => Self::Confirmed,
            _ => Self::Mixed,
        }
    }

    /// As [`Verdict::of`], over the conclusive cases. `None` is an inconclusive case, which is
    /// ignored.
    pub fn of_telling(cases: &[Option<bool>]) -> Self {
        let telling: Vec<bool> = cases.iter().copied().flatten().collect();
        if telling.is_empty() && !cases.is_empty() {
            return Self::CannotTell;
        }
        Self::of(&telling)
    }

    /// The verdict over cases decided by confidence intervals. `None` is undecided: its interval
    /// contains the limit, or there are too few rooms. A claim is confirmed or contradicted only if
    /// all intervals agree.
    pub fn of_intervals(cases: &[Option<bool>]) -> Self {
        match Self::of_telling(cases) {
            Self::Confirmed | Self::Contradicted if cases.contains(&None) => Self::Mixed,
            verdict => verdict,
        }
    }

    fn word(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::Contradicted => "contradicted",
            Self::Mixed => "mixed",
            Self::CannotTell => "cannot be told here",
            Self::Untested => "not tested",
        }
    }
}

/// Whether a claim holds for each of several cases: false if one case fails, else `None` if one
/// case is inconclusive.
pub fn holds_for_each(cases: &[Option<bool>]) -> Option<bool> {
    if cases.contains(&Some(false)) {
        Some(false)
    } else if cases.contains(&None) {
        None
    } else {
        Some(true)
    }
}

/// Minimum number of rooms for a bootstrap interval to be conclusive. Five differences of the same
/// sign occur by chance with probability 1/16.
const FEWEST_ROOMS: usize = 6;

/// Whether a mean over rooms is above zero; `None` if its interval is inconclusive.
pub fn is_above_zero(mean: &RoomMean) -> Option<bool> {
    if mean.rooms < FEWEST_ROOMS {
        None
    } else if mean.low > 0.0 {
        Some(true)
    } else if mean.high < 0.0 {
        Some(false)
    } else {
        None
    }
}

/// Whether a fraction of rooms is above one half; `None` if its interval is inconclusive.
pub fn is_most(share: &Rate) -> Option<bool> {
    if share.low > 0.5 {
        Some(true)
    } else if share.high < 0.5 {
        Some(false)
    } else {
        None
    }
}

/// The number of cases in which a claim holds, and of inconclusive cases, in words.
pub fn count_words(cases: &[Option<bool>], of_what: &str) -> String {
    let telling: Vec<bool> = cases.iter().copied().flatten().collect();
    let held = telling.iter().filter(|&&held| held).count();
    let silent = cases.len() - telling.len();

    let mut words = format!("so in {held} of {} {of_what}", telling.len());
    if silent > 0 {
        words.push_str(&format!("; {silent} more cannot tell"));
    }
    words
}

/// The table of claims, one row per claim.
pub fn section(claims: &[Claim]) -> Section {
    let mut section = Section::new("The paper's claims in these rooms");

    let columns: [Column<Claim>; 3] = [
        Text("claim", |claim| claim.claim.clone()),
        Text("here", |claim| claim.verdict.word().to_owned()),
        Text("what was found", |claim| claim.found.clone()),
    ];
    section.table(Table::of(claims, &columns));
    section
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: Wilson's interval of 3 of 3 rooms is 0.44 to 1 and contains one half. 10 of 10 rooms
    /// is conclusive, and so is 0 of 10.
    #[test]
    fn few_rooms_cannot_tell_what_most_do() {
        assert_eq!(is_most(&Rate::of(3, 3)), None);
        assert_eq!(is_most(&Rate::of(10, 10)), Some(true));
        assert_eq!(is_most(&Rate::of(0, 10)), Some(false));
    }

    /// Oracle: the meaning of "each": one failure decides, and one unknown case leaves it open.
    #[test]
    fn a_claim_about_each_fails_with_one() {
        assert_eq!(holds_for_each(&[Some(true), Some(true)]), Some(true));
        assert_eq!(holds_for_each(&[Some(true), None]), None);
        assert_eq!(holds_for_each(&[None, Some(false)]), Some(false));
    }

    /// Oracle: the words of the verdicts.
    #[test]
    fn cases_that_cannot_tell_decide_nothing() {
        let word = |cases: &[Option<bool>]| Verdict::of_telling(cases).word();
        assert_eq!(word(&[Some(true), None]), "confirmed");
        assert_eq!(word(&[Some(false), None]), "contradicted");
        assert_eq!(word(&[Some(false), Some(true)]), "mixed");
        assert_eq!(word(&[None, None]), "cannot be told here");

        let word = |cases: &[Option<bool>]| Verdict::of_intervals(cases).word();
        assert_eq!(word(&[Some(true), None]), "mixed");
        assert_eq!(word(&[Some(true), Some(true)]), "confirmed");
        assert_eq!(word(&[None]), "cannot be told here");

        let word = |cases: &[Option<bool>]| Verdict::of_telling(cases).word();
        assert_eq!(word(&[]), "not tested");

        assert_eq!(
            count_words(&[Some(true), Some(false), None], "rooms"),
            "so in 1 of 2 rooms; 1 more cannot tell"
        );
    }
}
