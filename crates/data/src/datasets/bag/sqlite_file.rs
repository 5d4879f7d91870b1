//! Reads the messages of a `.db3` file, the SQLite database that ROS 2 recorded to before Iron.
//!
//! | table | columns used |
//! | --- | --- |
//! | `topics` | `id`, `name`, `type` (the message type), `serialization_format` ("cdr") |
//! | `messages` | `id` in the order of writing, `topic_id`, `timestamp` (nanoseconds), `data` |

use seese3_core::Cause;
use std::collections::BTreeMap;
use std::path::Path;

use rusqlite::{Connection, OpenFlags, Row};

use super::message::{Kind, Message, Topic};
use crate::datasets::Error;

/// Calls `take` with every message of a supported type, and returns all topics.
pub fn each_message(
    file: &Path,
    take: &mut impl FnMut(&Message<'_>) -> Result<(), String>,
) -> Result<Vec<Topic>, Error> {
    let malformed = |problem: Cause| Error::Malformed {
        file: file.to_owned(),
        problem,
    };
    let damaged =
        |error: rusqlite::Error| malformed(format!("is a damaged .db3 bag: {error}").into());

    // An absolute path keeps SQLite from reading a name such as `file:a.db3` as a URI.
    let path = file.canonicalize().map_err(|cause| Error::Io {
        file: file.to_owned(),
        cause,
    })?;
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let database = Connection::open_with_flags(path, flags).map_err(damaged)?;
    for table in ["topics", "messages"] {
        if !has_table(&database, table).map_err(damaged)? {
            return Err(malformed(
                format!("is a database without the table '{table}': it is not a ROS 2 bag").into(),
            ));
        }
    }

    let topics = topics_of(&database).map_err(damaged)?;
    let mut query = database
        .prepare("SELECT topic_id, timestamp, data FROM messages ORDER BY id")
        .map_err(damaged)?;
    let mut rows = query.query(()).map_err(damaged)?;
    while let Some(row) = rows.next().map_err(damaged)? {
        let topic = topics.get(&row.get(0).map_err(damaged)?);
        if let Some((topic, kind)) = topic.and_then(|topic| Some((topic, topic.kind?))) {
            let message = message_of(row, topic, kind).map_err(damaged)?;
            take(&message).map_err(|problem| malformed(problem.into()))?;
        }
    }

    Ok(topics.into_values().collect())
}

/// Whether the database has this table. A view is not accepted: its query could run forever.
fn has_table(database: &Connection, name: &str) -> rusqlite::Result<bool> {
    let query = "SELECT count(*) FROM sqlite_schema WHERE type = 'table' AND name = ?1";
    database.query_row(query, [name], |row| row.get(0))
}

fn topics_of(database: &Connection) -> rusqlite::Result<BTreeMap<i64, Topic>> {
    let mut query = database.prepare("SELECT id, name, type, serialization_format FROM topics")?;
    let topics = query.query_map((), |row| {
        let schema: String = row.get(2)?;
        let encoding: String = row.get(3)?;
        let topic = Topic {
            name: row.get(1)?,
            kind: Kind::of(&schema, &encoding),
            schema,
        };
        Ok((row.get(0)?, topic))
    })?;

    topics.collect()
}

fn message_of<'a>(row: &'a Row<'_>, topic: &'a Topic, kind: Kind) -> rusqlite::Result<Message<'a>> {
    Ok(Message {
        topic: &topic.name,
        kind,
        log_time_ns: row.get(1)?,
        data: row.get_ref(2)?.as_blob()?,
    })
}
