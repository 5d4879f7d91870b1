//! Reads files that may be on a file system that does not answer.

use std::pin::pin;
use std::time::Duration;

use tokio::task::JoinError;

/// Time after which a file that is not read yet is reported in the log.
const LIMIT: Duration = Duration::from_secs(5);

/// Runs `read` on a blocking thread, as [`logged_if_slow`].
///
/// # Errors
/// [`JoinError`] if the read panicked or the runtime is stopping.
pub async fn read_logged_if_slow<T: Send + 'static>(
    what: &str,
    read: impl FnOnce() -> T + Send + 'static,
) -> Result<T, JoinError> {
    logged_if_slow(what, tokio::task::spawn_blocking(read)).await
}

/// Waits for `read`. Logs that reading `what` takes long, and goes on waiting: a second attempt
/// would use another thread and wait too.
pub async fn logged_if_slow<T>(what: &str, read: impl Future<Output = T>) -> T {
    let mut read = pin!(read);
    if let Ok(read) = tokio::time::timeout(LIMIT, &mut read).await {
        return read;
    }

    tracing::error!(
        limit_s = LIMIT.as_secs(),
        "reading {what} takes longer than the limit: its file system may not answer; what was read before stays \
         in use until it does"
    );
    let read = read.await;
    tracing::info!("{what} was read");
    read
}
