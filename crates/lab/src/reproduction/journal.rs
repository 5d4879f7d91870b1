//! Keeps what a run has finished, so that an interrupted run goes on from there.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Claim, Found, ReproducedAdapter};
use crate::experiments::Error;
use crate::report::Section;
use seese3_core::adapter::{Adapter, TrainingRecord};

/// The finished steps and the trained adapters of a run. Errors are reasons, in words.
pub trait Journal: Sync {
    /// A finished step; `None` if it is not finished.
    fn step(&self, name: &str) -> Result<Option<Value>, String>;
    /// Keeps a finished step.
    fn keep_step(&self, name: &str, step: &Value) -> Result<(), String>;
    /// A trained adapter by its published name; `None` if it is not trained.
    fn adapter(&self, name: &str) -> Result<Option<(Adapter, TrainingRecord)>, String>;
    /// Keeps a trained adapter.
    fn keep_adapter(&self, adapter: &ReproducedAdapter) -> Result<(), String>;
}

/// A journal that keeps nothing.
#[derive(Debug, Clone, Copy)]
pub struct NoJournal;

impl Journal for NoJournal {
    fn step(&self, _: &str) -> Result<Option<Value>, String> {
        Ok(None)
    }

    fn keep_step(&self, _: &str, _: &Value) -> Result<(), String> {
        Ok(())
    }

    fn adapter(&self, _: &str) -> Result<Option<(Adapter, TrainingRecord)>, String> {
        Ok(None)
    }

    fn keep_adapter(&self, _: &ReproducedAdapter) -> Result<(), String> {
        Ok(())
    }
}

/// A finished step as it is kept.
#[derive(Serialize, Deserialize)]
struct Step {
    section: Section,
    record: Value,
    claims: Vec<Claim>,
}

/// Runs the steps that are not kept yet.
pub(super) struct Kept<'a> {
    pub journal: &'a dyn Journal,
    /// Called with the name of a step before it.
    pub begin: &'a dyn Fn(&'static str),
}

impl Kept<'_> {
    /// The result of a step: the kept one, else that of `run`, which is then kept. Adds the claims
    /// of the step to `claims`.
    pub fn step<R: Serialize>(
        &self,
        name: &'static str,
        claims: &mut Vec<Claim>,
        run: impl FnOnce(&mut Vec<Claim>) -> Result<Found<R>, Error>,
    ) -> Result<Found<Value>, Error> {
        (self.begin)(name);
        let failed =
            |problem: serde_json::Error| Error::Journal(format!("step '{name}': {problem}"));
        let kept = self.journal.step(name).map_err(Error::Journal)?;
        let step: Step = match kept {
            Some(step) => serde_json::from_value(step).map_err(failed)?,
            None => {
                let mut own = Vec::new();
                let Found { section, record } = run(&mut own)?;
                let step = Step {
                    section,
                    record: serde_json::to_value(record).map_err(failed)?,
                    claims: own,
                };
                let value = serde_json::to_value(&step).map_err(failed)?;
                self.journal
                    .keep_step(name, &value)
                    .map_err(Error::Journal)?;
                step
            }
        };
        claims.extend(step.claims);
        Ok(Found {
            section: step.section,
            record: step.record,
        })
    }
}
