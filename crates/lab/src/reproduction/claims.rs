//! What the given rooms say about the paper's claims, and about ours.

use serde::Serialize;

use seese3_core::statistics::{Rate, RoomMean};

use crate::report::Section;

/// A claim and the evidence found for or against it.
pub struct Claim {
    /// The claim in one sentence.
    pub claim: &'static str,
    /// Whether these rooms confirm it.
    pub verdict: Verdict,
    /// The numbers behind the verdict, in words.
    pub found: String,
}

/// The outcome of testing a claim.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// The claim holds in every case.
    Confirmed,
    /// The claim holds in no case.
    Contradicted,
    /// The claim holds for some feature sets or rooms and not for others.
    Mixed,
    /// No case tells: the simplest answers fail there too, or every interval holds the limit.
    CannotTell,
    /// There was no case to test the claim on.
    Untested,
}

impl Verdict {
    /// Confirmed if the claim holds in every case, contradicted if it holds in none of them.
    pub fn of(holds: &[bool]) -> Self {
        let held = holds.iter().filter(|&&holds| holds).count();
        match held {
            _ if holds.is_empty() => Self::Untested,
            0 => Self::Contradicted,
            count if count == holds.len() => Self::Confirmed,
            _ => Self::Mixed,
        }
    }

    /// As [`Verdict::of`], over the cases that can tell: `None` is a case in which no method could
    /// have succeeded.
    pub fn of_telling(cases: &[Option<bool>]) -> Self {
        let telling: Vec<bool> = cases.iter().copied().flatten().collect();
        if telling.is_empty() && !cases.is_empty() {
            return Self::CannotTell;
        }
        Self::of(&telling)
    }

    /// The verdict over cases that are told by intervals: `None` is an interval that holds the limit.
    /// Only where every interval tells the same is a claim confirmed or contradicted.
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

/// Whether a claim about several things holds for each: it does not if it fails for one, and where one
/// cannot tell, all cannot.
pub fn holds_for_each(cases: &[Option<bool>]) -> Option<bool> {
    if cases.contains(&Some(false)) {
        Some(false)
    } else if cases.contains(&None) {
        None
    } else {
        Some(true)
    }
}

/// The fewest rooms whose resampled means say something: five of the same sign happen by chance in
/// one of sixteen cases.
const FEWEST_ROOMS: usize = 6;

/// Whether a mean over rooms is above zero, if its interval can tell.
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

/// Whether a share of rooms is above one half, if its interval can tell.
pub fn is_most(share: &Rate) -> Option<bool> {
    if share.low > 0.5 {
        Some(true)
    } else if share.high < 0.5 {
        Some(false)
    } else {
        None
    }
}

/// How many cases a claim holds in, and how many cannot tell, in words.
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

    let mut rows = vec![
        ["claim", "here", "what was found"]
            .map(str::to_owned)
            .to_vec(),
    ];

    for claim in claims {
        rows.push(vec![
            claim.claim.to_owned(),
            claim.verdict.word().to_owned(),
            claim.found.clone(),
        ]);
    }

    section.table(rows);
    section
}

/// A claim in `record.json`.
#[derive(Debug, Serialize)]
pub struct ClaimRecord {
    claim: &'static str,
    verdict: &'static str,
    found: String,
}

pub fn records(claims: &[Claim]) -> Vec<ClaimRecord> {
    let record = |claim: &Claim| ClaimRecord {
        claim: claim.claim,
        verdict: claim.verdict.word(),
        found: claim.found.clone(),
    };

    claims.iter().map(record).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: three rooms of three are too few for Wilson's interval, 0.44 to 1, to say that most
    /// rooms are won; ten of ten are enough, and none of ten says that most are not.
    #[test]
    fn few_rooms_cannot_tell_what_most_do() {
        assert_eq!(is_most(&Rate::of(3, 3)), None);
        assert_eq!(is_most(&Rate::of(10, 10)), Some(true));
        assert_eq!(is_most(&Rate::of(0, 10)), Some(false));
    }

    /// Oracle: the meaning of "each": one failure is enough, and one unknown leaves it open.
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
