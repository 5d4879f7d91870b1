//! Reads files that may be on a file system that does not answer.

use std::time::Duration;

use tokio::task::JoinError;

/// Time after which a file that is not read yet is reported in the log.
const LIMIT: Duration = Duration::from_secs(5);

/// Runs `read` on a blocking thread. Logs that `what` cannot be read once it takes longer than the
/// limit, and goes on waiting: a second attempt would use another thread and wait too.
///
/// # Errors
/// [`JoinError`] if the read panicked or the runtime is stopping.
pub async fn read_within_limit<T: Send + 'static>(
    what: &str,
    read: impl FnOnce() -> T + Send + 'static,
) -> Result<T, JoinError> {
    let mut reading = tokio::task::spawn_blocking(read);
    if let Ok(read) = tokio::time::timeout(LIMIT, &mut reading).await {
        return read;
    }

    tracing::error!(
        limit_s = LIMIT.as_secs(),
        "reading {what} takes longer than the limit: its file system does not answer; what was read before stays \
         in use until it does"
    );
    let read = reading.await;
    tracing::info!("{what} can be read again");
    read
}
