//! `seese3 pull`: downloads a room or an adapter from a server into a store.

use anyhow::{Context, bail};
use clap::Args;
use serde_json::json;

use super::ask::Server;
use super::output::say_published;
use super::push::target;
use super::store_option::DEFAULT_STORE;
use crate::output::{JsonOutput, say};
use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_server::ReceivedRoom;
use seese3_store::{Kind, Published, ResourceName, Store, UploadPolicy};

#[derive(Debug, Args)]
pub struct Pull {
    /// rooms/NAME or adapters/NAME, or one revision: rooms/NAME/revisions/NUMBER
    name: ResourceName,
    /// The store: a folder, created if it does not exist, or a URL of a bucket (feature `cloud`)
    #[arg(long, env = "SEESE3_STORE", default_value = DEFAULT_STORE)]
    store: String,
    #[command(flatten)]
    json: JsonOutput,
    /// The name in the store; the same if omitted
    #[arg(long = "as", value_name = "NAME")]
    renamed: Option<String>,
    /// Publish a new revision of the room or adapter of this name in the store, in place of its
    /// content. Without it, a name that the store has with other content is refused
    #[arg(long)]
    replace: bool,
    #[command(flatten)]
    server: Server,
}

impl Pull {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        let target = target(&self.name, self.renamed.as_deref())?;
        let client = self.server.connect().await?;
        let policy = if self.replace {
            UploadPolicy::Replace
        } else {
            UploadPolicy::Create
        };

        // Nothing is created before the download is complete.
        let (store, published) = match self.name.kind {
            Kind::Room => {
                let room = self.room(&client, &target).await?;
                let store = Store::create(&self.store)?;
                let published = store.upload_contents(room.contents(), policy).await;
                (store, published)
            }
            Kind::Adapter => {
                let request = pb::DownloadAdapterRequest {
                    adapter: self.name.name.clone(),
                    adapter_revision: self.name.revision,
                };
                let (adapter, weights) = client.download_adapter(request).await?;
                self.check_answer(adapter.revision.as_ref())?;
                let store = Store::create(&self.store)?;
                let published =
                    store.upload_adapter_files(&target.name, &adapter.manifest, weights, policy);
                let published = published.await;
                (store, published)
            }
        };
        let published = published.map_err(|error| exists(error, &target))?;
        self.report(&store, &target, &published)
    }

    /// Receives a room.
    async fn room(
        &self,
        client: &Client,
        target: &ResourceName,
    ) -> anyhow::Result<seese3_server::CompleteRoom> {
        use pb::download_room_response::Message;

        let request = pb::DownloadRoomRequest {
            room: self.name.name.clone(),
            room_revision: self.name.revision,
        };
        let (mut room, mut complete) = (None, None);
        let take = |received: pb::DownloadRoomResponse| -> anyhow::Result<()> {
            let begun =
                |room: Option<ReceivedRoom>| room.context("the download has no first message");
            match received.message {
                Some(Message::Room(first)) => {
                    self.check_answer(first.revision.as_ref())?;
                    let mut upload = first.upload.context("the download has no description")?;
                    upload.room.clone_from(&target.name);
                    room = Some(ReceivedRoom::begin(&upload)?);
                }
                Some(Message::Frames(batch)) => room = Some(begun(room.take())?.take(batch)?.0),
                Some(Message::Keypoints(part)) => {
                    let mut received = begun(room.take())?;
                    received.take_keypoints(&part)?;
                    room = Some(received);
                }
                Some(Message::End(end)) => complete = Some(begun(room.take())?.finish(&end)?),
                None => bail!(
                    "the download has an empty message; the server may be newer than this program"
                ),
            }
            Ok(())
        };
        client.download_room(request, take).await?;
        complete.context("the download ended early; pull again")
    }

    /// Checks that the server sends what was asked for.
    fn check_answer(&self, sent: Option<&pb::Revision>) -> anyhow::Result<()> {
        let sent = sent.context("the download does not state its revision")?;
        if sent.name != self.name.name
            || self
                .name
                .revision
                .is_some_and(|asked| asked != sent.revision)
        {
            bail!(
                "the server sends '{}' revision {}",
                sent.name,
                sent.revision
            );
        }
        Ok(())
    }

    fn report(
        &self,
        store: &Store,
        target: &ResourceName,
        published: &Published,
    ) -> anyhow::Result<()> {
        say_published(
            store,
            &format!("{} '{}'", target.kind, target.name),
            published,
        );
        if target.kind == Kind::Room && published.is_new {
            say("images, frame numbers and held-out marks are not downloaded");
        }
        self.json.write(&json!({
            "name": target.to_string(),
            "revision": published.revision,
            "created": published.is_new,
        }))
    }
}

/// Says how to keep both of two things that have one name.
fn exists(error: seese3_store::Error, target: &ResourceName) -> anyhow::Error {
    let is_there = matches!(error, seese3_store::Error::Exists { .. });
    let error = anyhow::Error::from(error);
    if !is_there {
        return error;
    }
    error.context(format!(
        "{target} is in the store with other content; give --as NAME, or --replace for a new revision"
    ))
}
