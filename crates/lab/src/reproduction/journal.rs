//! Keeps what a run has finished, so that another run with the same inputs reuses it.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::{Found, ReproducedAdapter, Reproduction};
use crate::experiments::Error;
use crate::experiments::adapter_sweep::content;
use seese3_core::adapter::{Adapter, TrainingRecord};
use seese3_core::training::RoomData;

/// Number of bytes of a hash of inputs in the name of a kept adapter.
const HASH_BYTES: usize = 8;

/// The finished parts and the trained adapters of runs. Errors are reasons, in words.
pub trait Journal: Sync {
    /// A finished part; `None` if it is not finished.
    fn part(&self, name: &str) -> Result<Option<Value>, String>;
    /// Keeps a finished part, instead of an older one with its name.
    fn keep_part(&self, name: &str, part: &Value) -> Result<(), String>;
    /// A trained adapter by the name it was kept under; `None` if it is not trained.
    fn adapter(&self, name: &str) -> Result<Option<(Adapter, TrainingRecord)>, String>;
    /// Keeps a trained adapter under a name of the journal.
    fn keep_adapter(&self, name: &str, adapter: &ReproducedAdapter) -> Result<(), String>;
}

/// A journal that keeps nothing.
#[derive(Debug, Clone, Copy)]
pub struct NoJournal;

impl Journal for NoJournal {
    fn part(&self, _: &str) -> Result<Option<Value>, String> {
        Ok(None)
    }

    fn keep_part(&self, _: &str, _: &Value) -> Result<(), String> {
        Ok(())
    }

    fn adapter(&self, _: &str) -> Result<Option<(Adapter, TrainingRecord)>, String> {
        Ok(None)
    }

    fn keep_adapter(&self, _: &str, _: &ReproducedAdapter) -> Result<(), String> {
        Ok(())
    }
}

/// A finished part as it is kept, with everything that it depends on.
#[derive(Serialize, Deserialize)]
struct Kept<T> {
    inputs: Value,
    result: T,
}

impl Reproduction<'_> {
    /// The inputs of a part: the program's version, the given options, and the rooms with their
    /// revisions, their features, and a hash of poses and features.
    pub(super) fn inputs(&self, options: Value, rooms: &[&[RoomData<'_>]]) -> Value {
        let names = |rooms: &&[RoomData<'_>]| -> Vec<String> {
            let room = |data: &RoomData<'_>| {
                let source = data.features.source();
                let content = content(data);
                format!("{} {} {content} {source:?}", data.room.id(), data.revision)
            };
            rooms.iter().map(room).collect()
        };
        json!({
            "version": env!("CARGO_PKG_VERSION"),
            "epochs_instead_of_the_presets": self.options.epochs,
            "options": options,
            "rooms": rooms.iter().map(names).collect::<Vec<_>>(),
        })
    }

    /// The result of a part: the kept one if it has the same inputs, else that of `run`, which is
    /// then kept.
    pub(super) fn kept<T: Serialize + DeserializeOwned>(
        &self,
        name: &str,
        inputs: Value,
        run: impl FnOnce() -> Result<T, Error>,
    ) -> Result<T, Error> {
        let failed =
            |problem: serde_json::Error| Error::Journal(format!("part '{name}': {problem}"));
        if let Some(kept) = self.journal.part(name).map_err(Error::Journal)?
            && kept.get("inputs") == Some(&inputs)
            // A part in the format of another build of the program is made again.
            && let Ok(kept) = serde_json::from_value::<Kept<T>>(kept)
        {
            return Ok(kept.result);
        }

        let kept = Kept {
            inputs,
            result: run()?,
        };
        let value = serde_json::to_value(&kept).map_err(failed)?;
        self.journal
            .keep_part(name, &value)
            .map_err(Error::Journal)?;
        Ok(kept.result)
    }

    /// The result of a step: the kept one if it has the same inputs, else that of `section`, which
    /// is then kept.
    pub(super) fn step<R: Serialize>(
        &self,
        name: &str,
        inputs: Value,
        section: fn(&Self) -> Result<Found<R>, Error>,
    ) -> Result<Found<Value>, Error> {
        self.kept(name, inputs, || {
            let Found {
                section,
                record,
                claims,
            } = section(self)?;
            let record = serde_json::to_value(record)
                .map_err(|problem| Error::Journal(format!("part '{name}': {problem}")))?;
            Ok(Found {
                section,
                record,
                claims,
            })
        })
    }

    /// The adapter of `what`, a room or a plan: the kept one if it has the same inputs, else that
    /// of `train`, which is then kept. `data` is a room with the adapter's features.
    pub(super) fn trained(
        &self,
        what: &str,
        inputs: &Value,
        data: &RoomData<'_>,
        train: impl FnOnce() -> Result<(Adapter, TrainingRecord), Error>,
    ) -> Result<ReproducedAdapter, Error> {
        let hash = Sha256::digest(inputs.to_string());
        let name = format!("kept-{}", hex::encode(&hash[..HASH_BYTES]));
        if let Some((adapter, record)) = self.journal.adapter(&name).map_err(Error::Journal)? {
            return Ok(ReproducedAdapter::new(what, data, adapter, record));
        }

        let (adapter, record) = train()?;
        let adapter = ReproducedAdapter::new(what, data, adapter, record);
        self.journal
            .keep_adapter(&name, &adapter)
            .map_err(Error::Journal)?;
        Ok(adapter)
    }
}
