//! Progress on standard error: a bar on a terminal, otherwise a line every 30 s.

use std::io::{IsTerminal, Write};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle, WeakProgressBar};

use super::output::is_silent;

/// Interval of progress lines if standard error is not a terminal. Shorter work prints none.
const LINE_EVERY: Duration = Duration::from_secs(30);

/// A bar over `steps` steps.
pub fn bar(steps: u64, what: &'static str) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(steps), target()).with_prefix(what);

    let template = "{prefix} {wide_bar} {pos}/{len} {msg} {eta}";
    let bar = bar.with_style(
        ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    say_lines_of(&bar, what);
    bar
}

/// A spinner with a message, for work of unknown length.
pub fn spinner(what: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template("{spinner} {prefix} {msg}");
    let style = style.unwrap_or_else(|_| ProgressStyle::default_spinner());
    let spinner = ProgressBar::with_draw_target(None, target())
        .with_style(style)
        .with_prefix(what);
    say_lines_of(&spinner, what);
    spinner
}

fn target() -> ProgressDrawTarget {
    if std::io::stderr().is_terminal() && !is_silent() {
        ProgressDrawTarget::stderr()
    } else {
        ProgressDrawTarget::hidden()
    }
}

/// Prints progress lines for a hidden bar, until it is finished or dropped.
fn say_lines_of(bar: &ProgressBar, what: &'static str) {
    if std::io::stderr().is_terminal() || is_silent() {
        return;
    }

    let bar = bar.downgrade();
    std::thread::spawn(move || {
        loop {
            std::thread::sleep(LINE_EVERY);
            let Some(line) = line_of(&bar, what) else {
                return;
            };
            let _ = writeln!(std::io::stderr(), "{}", line.trim_end());
        }
    });
}

/// The progress line of a bar; `None` once the bar is finished or dropped.
fn line_of(bar: &WeakProgressBar, what: &str) -> Option<String> {
    let bar = bar.upgrade().filter(|bar| !bar.is_finished())?;
    let seconds = bar.elapsed().as_secs();
    let message = bar.message();

    Some(match bar.length().filter(|length| *length > 0) {
        Some(length) => format!(
            "{what}: {} of {length} after {seconds} s, about {} s left {message}",
            bar.position(),
            bar.eta().as_secs()
        ),
        None => format!("{what}: {} after {seconds} s {message}", bar.position()),
    })
}
