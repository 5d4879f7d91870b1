//! `seese3 push`: uploads a room or an adapter to a server.

use std::sync::Arc;

use anyhow::bail;
use clap::Args;
use serde_json::json;

use super::ask::Server;
use super::output::say;
use super::store_option::StoreAndJson;
use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_server::{MESSAGE_BYTES, RoomPart, RoomParts, room_upload};
use seese3_store::{Kind, ResourceName, StoredRoom};

#[derive(Debug, Args)]
pub struct Push {
    /// rooms/NAME or adapters/NAME, or one revision: rooms/NAME/revisions/NUMBER
    name: ResourceName,
    #[command(flatten)]
    common: StoreAndJson,
    /// The name on the server; the same if omitted
    #[arg(long = "as", value_name = "NAME")]
    renamed: Option<String>,
    /// Publish a new revision of the room or adapter of this name on the server, in place of its
    /// content. Without it, a name that the server has with other content is refused
    #[arg(long, conflicts_with = "extend")]
    replace: bool,
    /// Append the frames to the room of this name on the server; their poses must be in its world
    /// frame
    #[arg(long)]
    extend: bool,
    /// With --extend: let the room's new revision omit features that these frames do not have
    #[arg(long, requires = "extend")]
    drop_other_features: bool,
    /// For a room: afterwards let the server fit an adapter to all of its frames
    #[arg(long, conflicts_with = "dry_run")]
    fit: bool,
    /// With --fit: the feature set; the room's only one if omitted
    #[arg(long, value_name = "NAME", requires = "fit")]
    features: Option<String>,
    /// Let the server check the upload, and publish nothing
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    server: Server,
}

impl Push {
    pub async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open()?;
        let target = target(&self.name, self.renamed.as_deref())?;
        if (self.extend || self.fit) && self.name.kind == Kind::Adapter {
            bail!("--extend and --fit are for rooms; an adapter is published as a whole");
        }
        let client = self.server.connect().await?;

        let mut has_keypoints = false;
        let (revision, created, served) = match self.name.kind {
            Kind::Room => {
                let stored = store.load_room(&self.name.name, self.name.revision).await?;
                has_keypoints = stored.keypoints.is_some();
                self.check_features(&stored)?;
                let upload = self.upload(&stored, &target)?;
                let messages = room_messages(stored, upload)?;
                let answer = client.upload_room(tokio_stream::iter(messages)).await;
                let answer = answer.map_err(unanswered)?;
                (answer.revision, answer.created, answer.served)
            }
            Kind::Adapter => {
                let files = store.adapter_files(&self.name.name, self.name.revision);
                let (manifest, weights) = files.await?;
                let upload = self.adapter_upload(manifest, &target);
                let messages = adapter_messages(upload, &weights);
                let answer = client.upload_adapter(tokio_stream::iter(messages)).await;
                let answer = answer.map_err(unanswered)?;
                (answer.revision, answer.created, answer.served)
            }
        };

        let Some(revision) = revision else {
            if !self.dry_run {
                bail!("the server does not say what it published; see `seese3 catalog`");
            }
            say(format_args!("{target} would be accepted"));
            return self
                .common
                .json
                .write(&json!({ "name": target.to_string(), "valid": true }));
        };
        let state = match (created, served) {
            (true, true) => "published and served",
            (false, true) if self.extend => "the room already has these frames",
            (false, true) => "already there, unchanged, and served",
            (true, false) => "published; the server serves another revision",
            (false, false) => "already there, unchanged; the server serves another revision",
        };
        say(format_args!(
            "{}: {state}",
            target.clone().at(revision.revision)
        ));

        if self.extend && created && has_keypoints {
            say(
                "the covariances of matched views are still those of the map before: encode and push the whole room to \
                 measure them again",
            );
        }

        let mut fitted_adapter = None;
        if self.fit {
            let fitted = fit_on_server(&client, &target, self.features).await?;
            fitted_adapter = Some(json!({ "name": fitted.name, "revision": fitted.revision }));
        }

        self.common.json.write(&json!({
            "name": target.to_string(),
            "revision": revision.revision,
            "created": created,
            "served": served,
            "fitted_adapter": fitted_adapter,
        }))
    }

    /// Checks, before the upload, that the feature set to fit is known.
    fn check_features(&self, stored: &StoredRoom) -> anyhow::Result<()> {
        let sets = stored.features.iter();
        let names: Vec<&str> = sets.map(|set| set.source().name.as_str()).collect();
        let one = names.len() == 1;
        let known = self
            .features
            .as_deref()
            .map_or(one, |set| names.contains(&set));
        if self.fit && !known {
            bail!("give --features: one of {}", names.join(", "));
        }
        Ok(())
    }

    fn mode(&self) -> pb::UploadMode {
        match (self.replace, self.extend) {
            (true, _) => pb::UploadMode::Replace,
            (_, true) => pb::UploadMode::Extend,
            (false, false) => pb::UploadMode::Create,
        }
    }

    /// The description of an adapter's upload.
    fn adapter_upload(&self, manifest: Vec<u8>, target: &ResourceName) -> pb::AdapterUpload {
        pb::AdapterUpload {
            adapter: target.name.clone(),
            mode: self.mode().into(),
            manifest,
            request_id: String::new(),
            validate_only: self.dry_run,
        }
    }

    /// The description of a room's upload.
    fn upload(&self, stored: &StoredRoom, target: &ResourceName) -> anyhow::Result<pb::RoomUpload> {
        let mut upload = room_upload(stored)?;
        if self.extend {
            // An extended room keeps its own format and license.
            upload.format.clear();
            upload.license.clear();
        }
        Ok(pb::RoomUpload {
            room: target.name.clone(),
            mode: self.mode().into(),
            validate_only: self.dry_run,
            drop_other_features: self.drop_other_features,
            ..upload
        })
    }
}

/// Lets the server fit an adapter to a room.
async fn fit_on_server(
    client: &Client,
    room: &ResourceName,
    features: Option<String>,
) -> anyhow::Result<pb::Revision> {
    let request = pb::FitAdapterRequest {
        room: room.name.clone(),
        feature_set: features.unwrap_or_default(),
        ..pb::FitAdapterRequest::default()
    };
    let fitted = client.fit_adapter(request, |_| ()).await?.revision;
    let fitted = fitted.unwrap_or_default();
    say(format_args!(
        "adapters/{}/revisions/{}: fitted to the room",
        fitted.name, fitted.revision
    ));
    Ok(fitted)
}

/// Says what may have happened to an upload without a response, and which option helps a refused one.
fn unanswered(error: seese3_client::Error) -> anyhow::Error {
    let is_late = matches!(error, seese3_client::Error::Deadline);
    let exists = error.reason().as_deref() == Some("ALREADY_EXISTS");
    let error = anyhow::Error::from(error);
    if exists {
        return error
            .context("give --replace for a new revision, --extend to add frames, or --as NAME");
    }
    if !is_late {
        return error;
    }
    error.context(
        "the server may still publish it; push it again, with a longer --deadline: what is there already is not \
         published twice",
    )
}

/// The resource name on the server. `renamed` is a plain name, or one with its collection.
pub fn target(source: &ResourceName, renamed: Option<&str>) -> anyhow::Result<ResourceName> {
    let collection = source.kind.collection();
    let name = match renamed {
        None => source.name.clone(),
        Some(given) => match given.split_once('/') {
            Some((first, name)) if first == collection => name.to_owned(),
            _ => given.to_owned(),
        },
    };

    Ok(format!("{collection}/{name}").parse()?)
}

/// The messages of a room upload.
fn room_messages(
    stored: StoredRoom,
    upload: pb::RoomUpload,
) -> anyhow::Result<impl Iterator<Item = pb::UploadRoomRequest> + Send + 'static> {
    use pb::upload_room_request::Message;

    let parts = RoomParts::new(Arc::new(stored))?.map(|part| match part {
        RoomPart::Frames(batch) => Message::Frames(batch),
        RoomPart::Keypoints(part) => Message::Keypoints(part),
        RoomPart::End(end) => Message::End(end),
    });
    let messages = std::iter::once(Message::Room(upload)).chain(parts);
    Ok(messages.map(|message| pb::UploadRoomRequest {
        message: Some(message),
    }))
}

fn adapter_messages(upload: pb::AdapterUpload, weights: &[u8]) -> Vec<pb::UploadAdapterRequest> {
    use pb::upload_adapter_request::Message;

    let parts = weights.chunks(MESSAGE_BYTES);
    let parts = parts.map(|part| Message::Weights(part.to_vec()));

    std::iter::once(Message::Adapter(upload))
        .chain(parts)
        .map(|message| pb::UploadAdapterRequest {
            message: Some(message),
        })
        .collect()
}
