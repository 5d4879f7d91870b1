//! `seese3 fit-tracking`: fits the parameters of filters that track cameras in rooms.

use clap::Args;
use serde_json::json;

use super::evaluate::{KeypointViews, Recordings};
use super::named::one_of;
use super::output::{JsonOutput, say, say_published};
use super::progress::bar;
use super::rooms::room_names;
use crate::table_files::TableFiles;
use seese3_core::splits::HoldOut;
use seese3_lab::experiments::tracked_room::{TrackedRoom, TrackingProtocol};
use seese3_lab::experiments::tracking_fit::{PoseScores, RecordedRoom, fit, scores, trial_count};
use seese3_lab::report::Table;
use seese3_robot::pose_filter::FilterParameters;
use seese3_store::Store;

#[derive(Debug, Args)]
pub struct FitTracking {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The rooms: names, or patterns with *. One set of parameters is fitted to all of them
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Rooms that judge the parameters and are not fitted to
    #[arg(long = "check")]
    checks: Vec<String>,
    /// The adapter that locates the views; without one, matched keypoints do
    #[arg(long)]
    adapter: Option<String>,
    /// Which frames are mapped and which are tracked
    #[arg(long, value_parser = one_of::<HoldOut>(), default_value = "blocks")]
    hold_out: HoldOut,
    /// Publish the parameters with each of --room. Servers then use them for streams that name the
    /// room
    #[arg(long)]
    publish: bool,
    #[command(flatten)]
    views: KeypointViews,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

impl FitTracking {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;
        let store = Store::open(&self.store)?;
        if self.publish {
            store.check_writable().await?;
        }
        let adapter = self.adapter.as_deref();
        let fitted = Recordings::load(&store, &self.rooms, adapter, &self.views).await?;
        let checked = if self.checks.is_empty() {
            None
        } else {
            Some(Recordings::load(&store, &self.checks, adapter, &self.views).await?)
        };

        // The fit begins at the default parameters, whatever is published.
        let protocol = |_: Option<FilterParameters>| TrackingProtocol {
            hold_out: self.hold_out,
            parameters: FilterParameters::default(),
            is_fitted: false,
        };
        let pool = self.views.runtime.pool()?;
        let (found, checks) = pool.install(|| -> anyhow::Result<_> {
            let rooms = fitted.tracked(&protocol)?;
            let recorded = recorded(&rooms);
            let progress = bar(trial_count() as u64, "fitting");
            let found = fit(&recorded, &FilterParameters::default(), &|| progress.inc(1));
            progress.finish_and_clear();

            let checks = match &checked {
                Some(checked) => {
                    let rooms = checked.tracked(&protocol)?;
                    let recorded = self::recorded(&rooms);
                    let of = |parameters: &FilterParameters| scores(&recorded, parameters);
                    Some([of(&FilterParameters::default()), of(&found.parameters)])
                }
                None => None,
            };
            Ok((found, checks))
        })?;

        say(format_args!(
            "{}, hold-out {}",
            fitted.words(),
            self.hold_out.name()
        ));
        say(factors_table(&found.factors));
        let mut table = Table::new(
            "rooms | parameters | log density per frame | fused m | TRACKING | TRACKING wrong | within 68 % | within 95 %",
        );
        add_scores(&mut table, "fitted to", &[found.before, found.after]);
        if let Some(checks) = &checks {
            add_scores(&mut table, "checked", checks);
        }
        self.files.say(&table, "parameters of filters")?;

        if self.publish {
            for name in room_names(&store, &self.rooms).await? {
                let published = store
                    .publish_tracking(&name, Some(found.parameters))
                    .await?;
                say_published(&store, &format!("room '{name}'"), &published);
            }
        }
        self.json.write(&json!({
            "parameters": found.parameters,
            "factors": found.factors.iter().cloned().collect::<std::collections::BTreeMap<_, _>>(),
            "fitted": {"default": found.before, "fitted": found.after},
            "checked": checks.map(|[before, after]| json!({"default": before, "fitted": after})),
        }))
    }
}

fn recorded<'a>(rooms: &'a [TrackedRoom<'a>]) -> Vec<RecordedRoom<'a>> {
    rooms.iter().map(RecordedRoom::of).collect()
}

fn factors_table(factors: &[(String, f64)]) -> Table {
    let mut table = Table::new("parameter | factor on the default");
    for (name, factor) in factors {
        table.row(name.clone(), [format!("{factor:.3}")]);
    }
    table
}

fn add_scores(table: &mut Table, rooms: &str, both: &[PoseScores; 2]) {
    for (scores, parameters) in both.iter().zip(["default", "fitted"]) {
        let numbers = [
            scores.log_density,
            scores.fused_m,
            scores.tracking,
            scores.tracking_wrong,
            scores.coverage[0],
            scores.coverage[1],
        ];
        let cells = numbers.into_iter().map(|value| format!("{value:.3}"));
        let cells = std::iter::once(parameters.to_owned()).chain(cells);
        table.row(rooms.to_owned(), cells);
    }
}
