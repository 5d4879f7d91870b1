//! What our rooms say of the paper's claims.

use serde_json::{Value, json};

use crate::report::Section;

/// A claim of the paper, and what was found.
pub struct Claim {
    /// The claim, in short.
    pub claim: &'static str,
    /// Whether our rooms bear it out.
    pub verdict: Verdict,
    /// The numbers.
    pub found: String,
}

/// What was found of a claim.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    Confirmed,
    Contradicted,
    /// Neither: it holds for some features or rooms.
    Mixed,
}

impl Verdict {
    /// Confirmed when it holds everywhere, contradicted when nowhere.
    pub fn of(holds: &[bool]) -> Self {
        match (
            holds.iter().all(|&held| held),
            holds.iter().any(|&held| held),
        ) {
            (true, _) => Self::Confirmed,
            (false, true) => Self::Mixed,
            (false, false) => Self::Contradicted,
        }
    }

    fn word(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::Contradicted => "contradicted",
            Self::Mixed => "mixed",
        }
    }
}

/// A line a claim.
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

pub fn json(claims: &[Claim]) -> Value {
    let entry = |claim: &Claim| json!({ "claim": claim.claim, "verdict": claim.verdict.word(), "found": claim.found });
    Value::Array(claims.iter().map(entry).collect())
}
