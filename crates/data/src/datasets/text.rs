//! Strict parsing of numbers in text files. Errors name the file and the line.

use seese3_core::Cause;
use std::path::Path;

use nalgebra::Matrix4;

use super::{DropReason, Error, read_text};

/// Reads the 4×4 matrix of a pose file, row by row. An inner error drops the frame; an outer error
/// refuses the recording.
pub(super) fn read_matrix(file: &Path) -> Result<Result<Matrix4<f64>, DropReason>, Error> {
    if !file.exists() {
        return Ok(Err(DropReason::MissingPoseFile));
    }

    let text = read_text(file)?;
    let mut numbers = Vec::with_capacity(16);
    for (line, words) in (1..).zip(text.lines()) {
        for word in words.split_whitespace() {
            numbers.push(number(file, line, word)?);
        }
    }

    // Too few numbers mean a truncated file, which drops one frame. Too many mean that this is not
    // a pose file.
    match numbers.len() {
        16 => Ok(Ok(Matrix4::from_row_slice(&numbers))),
        0..16 => Ok(Err(DropReason::TruncatedPoseFile)),
        more => Err(Error::Malformed {
            file: file.to_owned(),
            problem: format!("has {more} numbers, expected 16").into(),
        }),
    }
}

/// Parses a number, which may be infinite or NaN.
pub(super) fn number(file: &Path, line: usize, word: &str) -> Result<f64, Error> {
    word.parse()
        .map_err(|_| wrong(file, line, format!("'{word}' is not a number").into()))
}

/// Parses `N` finite numbers, separated by single spaces.
pub(super) fn finite_row<const N: usize>(
    file: &Path,
    line: usize,
    text: &str,
) -> Result<[f64; N], Error> {
    let words = spaced(file, line, text)?;
    let count = words.len();
    let words: [&str; N] = words.try_into().map_err(|_| {
        wrong(
            file,
            line,
            format!("has {count} columns, expected {N}").into(),
        )
    })?;

    let mut row = [0.0; N];
    for (value, word) in row.iter_mut().zip(words) {
        *value = number(file, line, word)?;
        if !value.is_finite() {
            return Err(wrong(file, line, format!("'{word}' is not finite").into()));
        }
    }

    Ok(row)
}

/// Splits a line into non-empty words separated by single spaces.
pub(super) fn spaced<'a>(file: &Path, line: usize, text: &'a str) -> Result<Vec<&'a str>, Error> {
    let words: Vec<&str> = text.split(' ').collect();
    if words
        .iter()
        .any(|word| word.is_empty() || word.contains(char::is_whitespace))
    {
        return Err(wrong(
            file,
            line,
            "columns must be separated by single spaces, with none at either end".into(),
        ));
    }

    Ok(words)
}

/// The lines with data, numbered from 1. Empty lines and `#` comments are skipped.
pub(super) fn data_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let has_data = |(_, line): &(usize, &str)| !line.is_empty() && !line.starts_with('#');
    (1..).zip(text.lines()).filter(has_data)
}

/// Nanoseconds from non-negative decimal seconds, exactly. Digits after the ninth are cut off.
pub(super) fn nanoseconds(seconds: &str) -> Option<i64> {
    let (whole, part) = seconds.split_once('.').unwrap_or((seconds, ""));
    let digits = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
    if whole.is_empty() || !digits(whole) || !digits(part) {
        return None;
    }

    // The fraction is padded to nine digits and parsed as an integer. At today's Unix times, a
    // double resolves only 2.4e-7 s.
    let fraction: String = part.chars().chain("000000000".chars()).take(9).collect();
    whole
        .parse::<i64>()
        .ok()?
        .checked_mul(1_000_000_000)?
        .checked_add(fraction.parse().ok()?)
}

pub(super) fn wrong(file: &Path, line: usize, problem: Cause) -> Error {
    Error::Line {
        file: file.to_owned(),
        line,
        problem,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: decimal notation by hand. A double would be off by up to 2.4e-7 s at such times.
    #[test]
    fn seconds_since_the_epoch_are_read_to_the_nanosecond() {
        for (text, expected) in [
            ("1700000000.100000", Some(1_700_000_000_100_000_000)),
            ("1700000000.123456789", Some(1_700_000_000_123_456_789)),
            ("6845.499", Some(6_845_499_000_000)),
            ("7", Some(7_000_000_000)),
            ("7.", Some(7_000_000_000)),
            ("-1.0", None),
            ("1e3", None),
            ("nan", None),
            ("", None),
            (".5", None),
            ("99999999999", None),
        ] {
            assert_eq!(nanoseconds(text), expected, "{text}");
        }
    }
}
