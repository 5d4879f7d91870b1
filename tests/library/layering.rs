//! The architecture, as far as Cargo does not enforce it: inside a crate, a module uses only those
//! above its line in `lib.rs`; formats and the outside world have one home each.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A crate of the workspace, and what it may not name.
struct CrateRules {
    /// Its folder under the repository's root.
    folder: &'static str,
    /// The fewest modules that `lib.rs` lists: fewer means that it was not read.
    fewest_modules: usize,
    /// Crates and modules that only some of its modules may name: (what, who).
    reserved: &'static [(&'static str, &'static [&'static str])],
}

const CRATES: [CrateRules; 4] = [
    CrateRules {
        folder: "crates/core/src",
        fewest_modules: 15,
        // Cargo keeps tokio, tonic, serde and object_store out; the standard library needs a test.
        reserved: &[
            ("std::fs", &[]),
            ("std::env", &[]),
            ("std::net", &[]),
            ("std::time", &[]),
            ("hnsw_rs", &["index"]),
        ],
    },
    CrateRules {
        folder: "crates/client/src",
        fewest_modules: 2,
        reserved: &[("std::fs", &[]), ("std::env", &[])],
    },
    CrateRules {
        folder: "crates/lab/src",
        fewest_modules: 5,
        reserved: &[
            ("std::fs", &[]),
            ("std::env", &[]),
            ("std::net", &[]),
            ("std::time", &["experiments"]),
            ("parquet", &["report"]),
            ("plotters", &["report"]),
        ],
    },
    CrateRules {
        folder: "src",
        fewest_modules: 6,
        reserved: &[
            ("seese3_lab", &["cli"]),
            // It is also a word of the command line.
            ("mcap", &["datasets", "export", "cli"]),
            ("rusqlite", &["datasets"]),
            ("foxglove", &["datasets", "export"]),
            ("ort", &["encoder"]),
            ("tract_onnx", &["encoder"]),
            ("fast_image_resize", &["encoder"]),
            ("tonic", &["service", "cli"]),
            ("prost", &["service", "encoder", "cli"]),
            ("tokio", &["service", "cli", "main"]),
            (
                "std::fs",
                &["datasets", "encoder", "store", "service", "cli"],
            ),
            ("std::env", &["cli"]),
            ("std::time", &["store", "service", "cli", "main"]),
            ("object_store", &["store"]),
            ("serde", &["datasets", "encoder", "store", "service", "cli"]),
            ("toml", &["encoder", "service", "cli"]),
            ("tokio_rustls", &["service"]),
            ("prometheus_client", &["service"]),
            ("axum", &["service"]),
        ],
    },
];

/// A source file of a crate.
struct Source {
    /// The module of `lib.rs` that it belongs to.
    module: String,
    path: PathBuf,
    text: String,
}

impl CrateRules {
    fn root(&self) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join(self.folder)
    }

    /// The modules of `lib.rs`, bottom first.
    fn modules(&self) -> Vec<String> {
        let lib = std::fs::read_to_string(self.root().join("lib.rs")).unwrap();
        let name = |line: &str| {
            let rest = line.trim_start_matches("pub ").strip_prefix("mod ")?;
            Some(rest.split(';').next()?.to_owned())
        };
        let modules: Vec<String> = lib.lines().filter_map(name).collect();

        assert!(
            modules.len() >= self.fewest_modules,
            "{}/lib.rs lists only {modules:?}",
            self.folder
        );
        modules
    }

    fn sources(&self) -> Vec<Source> {
        let root = self.root();
        let mut paths = Vec::new();
        rust_files(&root, &mut paths);

        paths
            .into_iter()
            .map(|path| {
                let first = path.strip_prefix(&root).unwrap().components().next();
                let first = first.unwrap().as_os_str().to_string_lossy().into_owned();
                Source {
                    module: first.trim_end_matches(".rs").to_owned(),
                    text: std::fs::read_to_string(&path).unwrap(),
                    path,
                }
            })
            .collect()
    }
}

fn rust_files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_files(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// The code of a file by line: no comments, and nothing of its unit tests.
fn code(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let tests = text.find("#[cfg(test)]").unwrap_or(text.len());
    text[..tests]
        .lines()
        .enumerate()
        .map(|(number, line)| (number + 1, line.split("//").next().unwrap_or("")))
}

/// The modules of its own crate that a line names after `crate::`.
fn used_modules(line: &str) -> Vec<String> {
    let identifier = |text: &str| -> String {
        text.trim()
            .chars()
            .take_while(|c| c.is_alphanumeric() || *c == '_')
            .collect()
    };

    let mut used = Vec::new();
    for rest in line.split("crate::").skip(1) {
        match rest.strip_prefix('{') {
            Some(list) => used.extend(
                list.split('}')
                    .next()
                    .unwrap_or("")
                    .split(',')
                    .map(identifier),
            ),
            None => used.push(identifier(rest)),
        }
    }

    used
}

/// Whether a line names a crate or module as a word of its own.
fn names(line: &str, what: &str) -> bool {
    let is_apart = |c: Option<char>| c.is_none_or(|c| !c.is_alphanumeric() && !"_-,\"".contains(c));
    line.match_indices(what).any(|(at, _)| {
        is_apart(line[..at].chars().next_back()) && is_apart(line[at + what.len()..].chars().next())
    })
}

/// Oracle: the list in each `lib.rs`.
#[test]
fn a_module_uses_only_those_above_it() {
    let mut wrong = Vec::new();
    for rules in CRATES {
        let order: BTreeMap<String, usize> = rules
            .modules()
            .into_iter()
            .enumerate()
            .map(|(place, name)| (name, place))
            .collect();

        for Source { module, path, text } in rules.sources() {
            let Some(&place) = order.get(&module) else {
                let is_root = ["lib", "main"].contains(&module.as_str());
                assert!(is_root, "{} is not in lib.rs", path.display());
                continue;
            };

            for (number, line) in code(&text) {
                for used in used_modules(line) {
                    if order.get(&used).is_some_and(|&other| other > place) {
                        let path = path.display();
                        wrong.push(format!(
                            "{path}:{number} uses {used}, which stands below it"
                        ));
                    }
                }
            }
        }
    }

    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Oracle: the table at the top of this file.
#[test]
fn formats_and_the_outside_world_have_one_home() {
    let mut wrong = Vec::new();
    for rules in CRATES {
        for Source { module, path, text } in rules.sources() {
            for (number, line) in code(&text) {
                for (what, homes) in rules.reserved {
                    let is_home = homes.contains(&module.as_str()) || module == "lib";
                    if names(line, what) && !is_home {
                        wrong.push(format!("{}:{number} names {what}", path.display()));
                    }
                }
            }
        }
    }

    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Oracle: the style guide.
#[test]
fn every_file_has_a_header() {
    for rules in CRATES {
        for Source { path, text, .. } in rules.sources() {
            assert!(text.starts_with("//! "), "{} has no header", path.display());
        }
    }
}
