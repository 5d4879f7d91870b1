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
        Some(length) => {
            let left = seconds_left(seconds, bar.position(), length)
                .map_or_else(String::new, |left| format!(", about {left} s left"));
            format!(
                "{what}: {} of {length} after {seconds} s{left} {message}",
                bar.position()
            )
        }
        None => format!("{what}: {} after {seconds} s {message}", bar.position()),
    })
}

/// The time left at the mean speed so far, seconds; `None` before the first item.
fn seconds_left(seconds: u64, position: u64, length: u64) -> Option<u64> {
    let items_left = length.saturating_sub(position);
    (position > 0).then(|| seconds * items_left / position)
}

#[cfg(test)]
mod tests {
    use super::seconds_left;

    /// Oracle: by hand. Two of four items in 120 s leave 120 s; before the first item, nothing is
    /// known.
    #[test]
    fn the_time_left_is_that_of_the_mean_speed() {
        assert_eq!(seconds_left(120, 2, 4), Some(120));
        assert_eq!(seconds_left(30, 0, 4), None);
        assert_eq!(seconds_left(90, 4, 4), Some(0));
    }
}
