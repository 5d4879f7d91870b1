//! Frames of HTTP/2 (RFC 9113), written by hand: for what no client library sends.

use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;

pub const NAVIGATE: &str = "/seese3.v1.NavigationService/Navigate";

/// A header in the literal form of HPACK: the beginning of the field, which says the name, and the
/// value.
pub fn literal(name: &[u8], value: &str) -> Vec<u8> {
    let mut field = name.to_vec();
    field.push(value.len() as u8);
    field.extend(value.as_bytes());
    field
}

/// A connection that has sent its preface and these settings.
pub async fn opened(address: &str, settings: &[u8]) -> TcpStream {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let mut bytes = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec();
    bytes.extend(frame(4, 0, 0, settings));
    stream.write_all(&bytes).await.unwrap();
    stream
}

/// A frame: its type, its flags, its stream and its payload.
pub fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let mut frame = (payload.len() as u32).to_be_bytes()[1..].to_vec();
    frame.extend([kind, flags]);
    frame.extend(stream.to_be_bytes());
    frame.extend(payload);
    frame
}

/// A message with its prefix, as gRPC has it in a body.
pub fn prefixed(message: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0];
    bytes.extend((message.len() as u32).to_be_bytes());
    bytes.extend(message);
    bytes
}

/// The headers of a call of `path` in the literal form of HPACK (RFC 7541, section 6.2.2).
pub fn headers(path: &str) -> Vec<u8> {
    [
        // POST and http stand in the static table.
        vec![0x83, 0x86],
        literal(&[0x04], path),
        literal(&[0x01], "test"),
        literal(&[0x0f, 0x10], "application/grpc"),
        literal(&[0x00, 2, b't', b'e'], "trailers"),
    ]
    .concat()
}

/// A connection with this many calls, each of which has sent these bytes of its body and says no
/// more.
pub async fn silent_calls(address: &str, count: u32, body: &[u8]) -> TcpStream {
    let mut stream = opened(address, &[]).await;
    let mut bytes = Vec::new();
    for call in 0..count {
        let id = 2 * call + 1;
        bytes.extend(frame(1, 4, id, &headers(NAVIGATE)));
        if !body.is_empty() {
            bytes.extend(frame(0, 0, id, body));
        }
    }

    stream.write_all(&bytes).await.unwrap();
    stream
}
