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

/// Instructions of SQLite's virtual machine between two calls of the progress handler.
const INSTRUCTIONS_PER_CHECK: u32 = 100_000;
/// Maximum number of instructions per byte of the file. A message takes about 15, and at least 8
/// bytes.
const INSTRUCTIONS_PER_BYTE: u64 = 10;

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
    let mut database = Connection::open_with_flags(path, flags).map_err(damaged)?;
    limit_instructions(&mut database, file).map_err(damaged)?;
    for table in ["topics", "messages"] {
        if !has_table(&database, table).map_err(damaged)? {
            let problem = format!(
                "is a database without the table '{table}' of plain columns: it is not a ROS 2 bag"
            );
            return Err(malformed(problem.into()));
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

/// Ends a query after a number of instructions in proportion to the size of the file: a damaged or
/// hostile file could make it run forever.
fn limit_instructions(database: &mut Connection, file: &Path) -> rusqlite::Result<()> {
    let bytes = file.metadata().map_or(0, |metadata| metadata.len());
    let most = INSTRUCTIONS_PER_BYTE * bytes / u64::from(INSTRUCTIONS_PER_CHECK) + 10;
    let mut checks = 0;
    let is_over = move || {
        checks += 1;
        checks > most
    };
    database.progress_handler(INSTRUCTIONS_PER_CHECK as i32, Some(is_over))
}

/// Whether the database has this table, with plain columns only. Views, virtual tables and
/// generated columns are not accepted: they compute what is not in the file, without a bound.
fn has_table(database: &Connection, name: &str) -> rusqlite::Result<bool> {
    let query = "SELECT count(*) FROM sqlite_schema AS one WHERE type = 'table' AND name = ?1 AND rootpage > 0 \
                 AND NOT EXISTS (SELECT * FROM pragma_table_xinfo(one.name) WHERE hidden <> 0)";
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

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use super::*;

    /// Oracle: the contract: a query without an end is ended.
    #[test]
    fn an_endless_query_is_ended() {
        let mut database = Connection::open_in_memory().unwrap();
        limit_instructions(&mut database, Path::new("")).unwrap();
        let endless =
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT max(i) FROM n";
        let ended = database.query_row(endless, (), |row| row.get::<_, i64>(0));
        let code = ended.unwrap_err().sqlite_error_code();
        assert_eq!(code, Some(rusqlite::ErrorCode::OperationInterrupted));
    }
}
