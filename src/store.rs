//! `seese3 store`: manages a store.

use std::time::Duration;

use anyhow::bail;
use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::output::say;
use super::progress::spinner;
use super::store_option::StoreAndJson;
use seese3_store::{
    Choice, Contents, GRACE, GarbagePolicy, Kind, Publishers, ResourceName, RevisionContents,
};

#[derive(Debug, Args)]
pub struct StoreCommand {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// List the rooms and adapters, with their revisions and defaults
    List(StoreAndJson),
    /// Show every revision of one room or adapter
    Show(Show),
    /// Show or set defaults: the revision that a name stands for, and the adapter of a room
    Default(Default),
    /// Remove a room, an adapter or one revision; `gc` frees the space
    Rm(Remove),
    /// Remove unreferenced files: from interrupted writes, and of removed revisions
    Gc(CollectGarbage),
    /// Read everything and check it: checksums, golden vectors, references
    Verify(StoreAndJson),
}

#[derive(Debug, Args)]
struct Show {
    /// rooms/NAME or adapters/NAME, or one revision: rooms/NAME/revisions/NUMBER
    name: ResourceName,
    #[command(flatten)]
    common: StoreAndJson,
}

#[derive(Debug, Args)]
struct Default {
    /// A room or an adapter with a revision, or a room followed by its adapter. All defaults are
    /// shown if omitted
    name: Option<ResourceName>,
    /// Adapter of the room for requests that name none
    #[arg(requires = "name", conflicts_with = "unset")]
    adapter: Option<ResourceName>,
    /// Remove the default: back to the newest revision, and the adapter that is preferred
    /// automatically
    #[arg(long, requires = "name")]
    unset: bool,
    /// Undo the last change of defaults
    #[arg(long, conflicts_with_all = ["name", "unset"])]
    back: bool,
    #[command(flatten)]
    common: StoreAndJson,
}

#[derive(Debug, Args)]
struct Remove {
    /// rooms/NAME or adapters/NAME, or one revision: rooms/NAME/revisions/NUMBER
    name: ResourceName,
    /// Only print what would be removed
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    common: StoreAndJson,
}

#[derive(Debug, Args)]
struct CollectGarbage {
    /// Keep files that were written in the last SECONDS by the store's own clock, at least 3600:
    /// they may belong to a publication in progress
    #[arg(long, value_name = "SECONDS", default_value_t = GRACE.as_secs())]
    older_than: u64,
    /// State that no other program publishes to the store meanwhile: --older-than may then be less
    /// than 3600
    #[arg(long)]
    no_concurrent_publishers: bool,
    /// Only print what would be removed
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    common: StoreAndJson,
}

impl StoreCommand {
    pub async fn run(self) -> anyhow::Result<()> {
        match self.action {
            Action::List(common) => list(&common).await,
            Action::Show(arguments) => arguments.run().await,
            Action::Default(arguments) => arguments.run().await,
            Action::Rm(arguments) => arguments.run().await,
            Action::Gc(arguments) => arguments.run().await,
            Action::Verify(common) => verify(&common).await,
        }
    }
}

async fn list(common: &StoreAndJson) -> anyhow::Result<()> {
    let store = common.open()?;
    let contents = store.contents().await?;
    let listed: Vec<Value> = contents.iter().map(contents_json).collect();
    common.json.write(&json!({ "contents": listed }))?;

    for held in &contents {
        let current = held
            .revisions
            .iter()
            .find(|held_revision| held_revision.revision == held.current);
        let about = current.map_or_else(|| "is missing".to_owned(), about);
        say(format_args!("{}  {}", headline(held), about));
    }
    Ok(())
}

impl Show {
    async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open()?;
        let held = store.contents_of(&self.name).await?;
        self.common.json.write(&contents_json(&held))?;

        say(headline(&held));
        for revision in &held.revisions {
            let is_current = revision.revision == held.current;
            let mark = if is_current { "*" } else { " " };
            say(format_args!(
                "{mark} revisions/{}  {}",
                revision.revision,
                about(revision)
            ));
        }
        Ok(())
    }
}

impl Default {
    async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open()?;

        if self.back {
            store.take_back_choice().await?;
        } else if let Some(choice) = self.choice()? {
            store.choose(&choice).await?;
        }

        // Report the resulting defaults in each case.
        let contents = store.contents().await?;
        let listed: Vec<Value> = contents.iter().map(contents_json).collect();
        self.common.json.write(&json!({ "contents": listed }))?;

        let chosen: Vec<&Contents> = contents
            .iter()
            .filter(|held| held.is_chosen || held.default_adapter.is_some())
            .collect();
        if chosen.is_empty() {
            say("no defaults are set: a name stands for its newest revision");
        }
        for held in chosen {
            say(headline(held));
        }
        Ok(())
    }

    fn choice(&self) -> anyhow::Result<Option<Choice>> {
        let Some(name) = &self.name else {
            return Ok(None);
        };

        Ok(Some(match (&self.adapter, name.kind, name.revision) {
            (None, _, None) if self.unset => Choice::Nothing(name.clone()),
            (None, _, Some(_)) if self.unset => bail!("--unset takes a name without a revision"),
            (None, _, Some(_)) => Choice::Revision(name.clone()),
            (Some(adapter), Kind::Room, None)
                if adapter.kind == Kind::Adapter && adapter.revision.is_none() =>
            {
                Choice::Adapter {
                    room: name.name.clone(),
                    adapter: adapter.name.clone(),
                }
            }
            _ => bail!(
                "name a revision ({name}/revisions/NUMBER), a room and an adapter (rooms/NAME \
                 adapters/NAME), or give --unset"
            ),
        }))
    }
}

impl Remove {
    async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open()?;
        let (removed, word) = if self.dry_run {
            (store.check_removable(&self.name).await?, "would remove")
        } else {
            (store.remove(&self.name).await?, "removed")
        };

        self.common.json.write(&json!({
            "name": self.name.to_string(),
            "revisions": removed.revisions,
            "dry_run": self.dry_run,
        }))?;

        let numbers: Vec<String> = removed.revisions.iter().map(u64::to_string).collect();
        say(format_args!(
            "{word} {}: revisions {}; `seese3 store gc` frees their space",
            self.name,
            numbers.join(", ")
        ));
        Ok(())
    }
}

impl CollectGarbage {
    async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open()?;
        let policy = GarbagePolicy {
            older_than: Duration::from_secs(self.older_than),
            publishers: match self.no_concurrent_publishers {
                true => Publishers::None,
                false => Publishers::Concurrent,
            },
        };
        let (garbage, word) = if self.dry_run {
            (store.find_garbage(policy).await?, "would free")
        } else {
            (store.collect_garbage(policy).await?, "freed")
        };

        self.common.json.write(&json!({
            "files": garbage.files,
            "bytes": garbage.bytes(),
            "left_alone": garbage.left_alone,
            "dry_run": self.dry_run,
        }))?;

        for file in &garbage.files {
            say(&file.path);
        }
        for folder in &garbage.left_alone {
            say(format_args!("left alone: {folder}"));
        }
        say(format_args!(
            "{word} {} in {} files",
            size(garbage.bytes()),
            garbage.files.len()
        ));
        Ok(())
    }
}

async fn verify(common: &StoreAndJson) -> anyhow::Result<()> {
    let store = common.open()?;
    let progress = spinner("verifying");
    let findings = store
        .verify(&|resource| progress.set_message(resource.to_string()))
        .await?;
    progress.finish_and_clear();

    common.json.write(&json!({ "findings": findings }))?;
    for finding in &findings {
        say(format_args!("{}: {}", finding.resource, finding.problem));
    }

    match findings.len() {
        0 => {
            say("everything can be read and is consistent");
            Ok(())
        }
        found => bail!("{found} findings"),
    }
}

/// The name, the current revision and the defaults.
fn headline(held: &Contents) -> String {
    let chosen = if held.is_chosen { ", chosen" } else { "" };
    let adapter = held.default_adapter.as_ref();
    let adapter = adapter.map_or_else(String::new, |name| format!(", default adapters/{name}"));
    let count = held.revisions.len();

    format!(
        "{}  revision {}{chosen}, {count} kept{adapter}",
        held.resource, held.current
    )
}

fn about(revision: &RevisionContents) -> String {
    match &revision.manifest {
        Ok(summary) => format!(
            "{}  {}  {}",
            summary.created.get(..19).unwrap_or(&summary.created),
            size(summary.bytes),
            summary.about
        ),
        Err(problem) => problem.clone(),
    }
}

fn contents_json(held: &Contents) -> Value {
    let revision = |revision: &RevisionContents| match &revision.manifest {
        Ok(summary) => json!({
            "revision": revision.revision,
            "created": summary.created,
            "bytes": summary.bytes,
            "about": summary.about,
        }),
        Err(problem) => json!({ "revision": revision.revision, "problem": problem }),
    };

    json!({
        "name": held.resource.to_string(),
        "current": held.current,
        "chosen": held.is_chosen,
        "default_adapter": held.default_adapter,
        "revisions": held.revisions.iter().map(revision).collect::<Vec<_>>(),
    })
}

/// A size with a suitable unit.
fn size(bytes: u64) -> indicatif::DecimalBytes {
    indicatif::DecimalBytes(bytes)
}
