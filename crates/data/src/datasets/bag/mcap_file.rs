//! Reads the messages of an MCAP file record by record, whatever its size.

use seese3_core::Cause;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

use mcap::records::{Channel, Record, SchemaHeader};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::message::{Kind, Message, Topic};
use crate::datasets::Error;

/// Bounds of the length limit of records and unpacked chunks, bytes. The limit is the file's
/// length, clamped to this range; a file with a longer record is damaged.
const LONGEST_RECORD: std::ops::Range<usize> = 1 << 28..1 << 30;

/// Calls `take` with every message of a supported type, and returns all topics.
pub fn each_message(
    file: &Path,
    take: &mut impl FnMut(&Message<'_>) -> Result<(), String>,
) -> Result<Vec<Topic>, Error> {
    let io = |cause| Error::Io {
        file: file.to_owned(),
        cause,
    };
    let malformed = |problem: Cause| Error::Malformed {
        file: file.to_owned(),
        problem,
    };
    let damaged = |error: mcap::McapError| {
        malformed(format!("is a truncated or damaged MCAP file: {error}").into())
    };

    let mut source = seese3_files::open(file).map_err(io)?;
    let length = source.metadata().map_err(io)?.len();
    let length = usize::try_from(length).unwrap_or(usize::MAX);
    // CRCs are checked before messages are used: flipped bits would decode as wrong poses.
    let options = LinearReaderOptions::default()
        .with_prevalidate_chunk_crcs(true)
        .with_validate_data_section_crc(true)
        .with_record_length_limit(length.clamp(LONGEST_RECORD.start, LONGEST_RECORD.end));
    let mut reader = LinearReader::new_with_options(options);
    let mut schemas = BTreeMap::new();
    let mut topics: BTreeMap<u16, Topic> = BTreeMap::new();

    while let Some(event) = reader.next_event() {
        match event.map_err(damaged)? {
            LinearReadEvent::ReadRequest(wanted) => {
                let read = source.read(reader.insert(wanted)).map_err(io)?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { data, opcode } => {
                match mcap::parse_record(opcode, data).map_err(damaged)? {
                    Record::Schema { header, .. } => {
                        schemas.insert(header.id, header);
                    }
                    Record::Channel(channel) => {
                        topics.insert(channel.id, topic_of(channel, &schemas));
                    }
                    Record::Message { header, data } => {
                        let topic = topics.get(&header.channel_id);
                        if let Some((topic, kind)) =
                            topic.and_then(|topic| Some((topic, topic.kind?)))
                        {
                            take(&Message {
                                topic: &topic.name,
                                kind,
                                log_time_ns: i64::try_from(header.log_time).unwrap_or(i64::MAX),
                                data: &data,
                            })
                            .map_err(|problem| malformed(problem.into()))?;
                        }
                    }
                    _ => {}
                }
            }
        }
    }

    Ok(topics.into_values().collect())
}

fn topic_of(channel: Channel, schemas: &BTreeMap<u16, SchemaHeader>) -> Topic {
    let schema = schemas.get(&channel.schema_id);
    let schema = schema.map_or(String::new(), |schema| schema.name.clone());
    Topic {
        kind: Kind::of(&schema, &channel.message_encoding),
        name: channel.topic,
        schema,
    }
}
