//! `--shard I/N`: one of several jobs that divide a list of tasks between them.

use std::str::FromStr;

/// Shard `part` of `parts`, from 1 on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    pub part: usize,
    pub parts: usize,
}

impl Shard {
    /// The tasks of this shard: every `parts`-th one. Together, the shards take each task once.
    pub fn tasks<T>(self, all: Vec<T>) -> Vec<T> {
        all.into_iter()
            .skip(self.part - 1)
            .step_by(self.parts)
            .collect()
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text
            .split_once('/')
            .and_then(|(part, parts)| Some((part.parse().ok()?, parts.parse().ok()?)));
        match parts {
            Some((part, parts)) if (1..=parts).contains(&part) => Ok(Self { part, parts }),
            _ => Err("must be I/N with I from 1 to N".to_owned()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition of a partition.
    #[test]
    fn shards_take_each_task_once() {
        for parts in 1..=12 {
            let mut taken: Vec<usize> = (1..=parts)
                .flat_map(|part| Shard { part, parts }.tasks((0..10).collect()))
                .collect();
            taken.sort_unstable();
            assert_eq!(taken, (0..10).collect::<Vec<_>>());
        }
    }

    /// Oracle: the documented form.
    #[test]
    fn only_shards_that_exist_are_parsed() {
        assert_eq!("2/4".parse(), Ok(Shard { part: 2, parts: 4 }));
        for wrong in ["", "1", "0/4", "5/4", "1/0", "a/4", "1/4/2", "-1/4"] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }
}
