//! The architecture, as far as Cargo does not enforce it: inside a crate, a module uses only those
//! above its line in `lib.rs`, and no two modules of a folder use each other; formats and the
//! outside world have one home each.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    reason = "a failed step is a failed test"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// A crate of the workspace, and what it may not name.
struct CrateRules {
    /// Its folder under the repository's root.
    folder: &'static str,
    /// The fewest modules that `lib.rs` lists: fewer means that it was not read.
    fewest_modules: usize,
    /// Crates and modules that only some of its modules may name: (what, who).
    reserved: &'static [&'static [(&'static str, &'static [&'static str])]],
}

/// Crates that only compute: no files, environment, network or clock.
const COMPUTES: &[(&str, &[&str])] = &[
    ("std::fs", &[]),
    ("std::env", &[]),
    ("std::net", &[]),
    ("std::time", &[]),
];

const CRATES: [CrateRules; 10] = [
    CrateRules {
        folder: "crates/core/src",
        fewest_modules: 15,
        reserved: &[COMPUTES, &[("hnsw_rs", &["index"])]],
    },
    CrateRules {
        folder: "crates/robot/src",
        fewest_modules: 5,
        reserved: &[COMPUTES],
    },
    CrateRules {
        folder: "crates/data/src",
        fewest_modules: 4,
        reserved: &[&[
            ("mcap", &["datasets", "export"]),
            ("rusqlite", &["datasets"]),
            ("foxglove", &["datasets", "export"]),
            ("std::fs", &["datasets"]),
            ("std::env", &[]),
            ("std::time", &[]),
        ]],
    },
    CrateRules {
        folder: "crates/encoder/src",
        fewest_modules: 10,
        reserved: &[&[
            ("ort", &["onnxruntime"]),
            ("tract_onnx", &["tract"]),
            ("std::env", &[]),
            ("std::time", &[]),
        ]],
    },
    CrateRules {
        folder: "crates/store/src",
        fewest_modules: 10,
        reserved: &[&[("std::env", &["bucket"]), ("std::net", &[])]],
    },
    CrateRules {
        folder: "crates/studio/src",
        fewest_modules: 10,
        reserved: &[COMPUTES],
    },
    CrateRules {
        folder: "crates/lab/src",
        fewest_modules: 5,
        reserved: &[&[
            ("std::fs", &[]),
            ("std::env", &[]),
            ("std::net", &[]),
            ("std::time", &["experiments"]),
            ("parquet", &["report"]),
            ("plotters", &["report"]),
        ]],
    },
    CrateRules {
        folder: "crates/client/src",
        fewest_modules: 2,
        reserved: &[&[("std::fs", &[]), ("std::env", &[])]],
    },
    CrateRules {
        folder: "crates/server/src",
        fewest_modules: 20,
        reserved: &[&[
            ("jsonwebtoken", &["auth"]),
            ("prometheus_client", &["metrics"]),
            ("axum", &["operations"]),
            ("std::env", &[]),
        ]],
    },
    CrateRules {
        folder: "src",
        fewest_modules: 20,
        reserved: &[&[("tokio_rustls", &[]), ("object_store", &[])]],
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
        let lib = std::fs::read_to_string(self.root().join("lib.rs"));
        let lib = lib.or_else(|_| std::fs::read_to_string(self.root().join("main.rs")));
        let lib = lib.unwrap();
        let name = |line: &str| {
            let rest = line.trim_start_matches("pub ").strip_prefix("mod ")?;
            Some(rest.split(';').next()?.to_owned())
        };
        let modules: Vec<String> = lib.lines().filter_map(name).collect();

        assert!(
            modules.len() >= self.fewest_modules,
            "{} lists only {modules:?}",
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

/// Everything before a file's unit tests, without comments.
fn production(text: &str) -> String {
    code(text).map(|(_, line)| format!("{line}\n")).collect()
}

/// The paths that a `use` tree names: `crate::{a, b::{c, d}}` names `crate::a`, `crate::b::c`, ….
fn leaves(prefix: &[String], tree: &str, found: &mut Vec<Vec<String>>) {
    let tree = tree.trim();
    if let Some(list) = tree.strip_prefix('{') {
        let mut depth = 0;
        let is_border = |c: char| {
            depth += i32::from(c == '{') - i32::from(c == '}');
            c == ',' && depth == 0
        };
        let list = list.strip_suffix('}').unwrap_or(list);
        let branches: Vec<&str> = list.split(is_border).collect();
        branches
            .iter()
            .filter(|branch| !branch.trim().is_empty())
            .for_each(|branch| leaves(prefix, branch, found));
        return;
    }

    let name: String = tree.chars().take_while(|c| is_word(*c)).collect();
    let mut path = prefix.to_vec();
    path.push(name.clone());
    match tree[name.len()..].strip_prefix("::") {
        Some(rest) => leaves(&path, rest, found),
        None => found.push(path),
    }
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// The paths that a file names after `crate::` or `super::`, in `use` and in place.
fn named_paths(text: &str) -> Vec<Vec<String>> {
    let text = production(text);
    let mut found = Vec::new();
    for start in ["crate::", "super::"] {
        for (at, _) in text.match_indices(start) {
            let before = text[..at].chars().next_back();
            if before.is_some_and(|c| is_word(c) || c == ':') {
                continue;
            }

            // A tree in braces ends with them, a path in place with its last word.
            let rest = &text[at..];
            let end = rest.find(';').unwrap_or(rest.len());
            let is_use = text[..at].trim_end().ends_with("use");
            let tree = match is_use {
                true => rest[..end].to_owned(),
                false => rest
                    .chars()
                    .take_while(|c| is_word(*c) || *c == ':')
                    .collect(),
            };
            leaves(&[], &tree, &mut found);
        }
    }

    found
}

/// The modules of a crate, by path, and those of the same crate that each uses.
fn uses(rules: &CrateRules) -> BTreeMap<Vec<String>, BTreeSet<Vec<String>>> {
    let root = rules.root();
    let module = |path: &Path| -> Vec<String> {
        let path = path.strip_prefix(&root).unwrap().with_extension("");
        let words = path.iter().map(|word| word.to_string_lossy().into_owned());
        words
            .filter(|word| !["mod", "lib", "main"].contains(&word.as_str()))
            .collect()
    };
    let sources = rules.sources();
    let modules: BTreeSet<Vec<String>> = sources.iter().map(|file| module(&file.path)).collect();

    let mut uses = BTreeMap::new();
    for Source { path, text, .. } in &sources {
        let user = module(path);
        let used = named_paths(text).into_iter().map(|named| {
            let climbs = named.iter().take_while(|word| *word == "super").count();
            let mut used = match named[0].as_str() {
                "crate" => named[1..].to_vec(),
                _ => [
                    &user[..user.len() - climbs.min(user.len())],
                    &named[climbs..],
                ]
                .concat(),
            };
            while !modules.contains(&used) {
                used.pop();
            }
            used
        });
        uses.insert(user.clone(), used.filter(|used| *used != user).collect());
    }

    uses
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

        for (user, used) in uses(&rules) {
            let Some(first) = user.first() else {
                continue;
            };
            let Some(place) = order.get(first) else {
                panic!("{} does not list {first}", rules.folder);
            };

            for used in used {
                if used.first().and_then(|used| order.get(used)) > Some(place) {
                    wrong.push(format!(
                        "{}: {} uses {}, which stands below it",
                        rules.folder,
                        user.join("::"),
                        used.join("::")
                    ));
                }
            }
        }
    }

    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Oracle: a graph without cycles can be emptied by taking away, again and again, what uses
/// nothing.
#[test]
fn modules_of_a_folder_do_not_use_each_other_in_circles() {
    let mut wrong = Vec::new();
    for rules in CRATES {
        let uses = uses(&rules);
        let folders: BTreeSet<Vec<String>> = uses
            .keys()
            .filter(|module| !module.is_empty())
            .map(|module| module[..module.len() - 1].to_vec())
            .collect();

        for folder in folders {
            // Which module of the folder uses which other one, whatever is inside them.
            let child = |module: &[String]| match module.strip_prefix(folder.as_slice()) {
                Some([child, ..]) => Some(child.clone()),
                _ => None,
            };
            let mut graph: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
            for (user, used) in &uses {
                let Some(user) = child(user) else { continue };
                let others = used.iter().filter_map(|used| child(used));
                let others: Vec<String> = others.filter(|other| *other != user).collect();
                graph.entry(user).or_default().extend(others);
            }

            while let Some(free) = graph
                .iter()
                .find(|(_, used)| !used.iter().any(|used| graph.contains_key(used)))
                .map(|(module, _)| module.clone())
            {
                graph.remove(&free);
            }
            if !graph.is_empty() {
                let circle: Vec<&String> = graph.keys().collect();
                wrong.push(format!(
                    "{} {}: {circle:?}",
                    rules.folder,
                    folder.join("::")
                ));
            }
        }
    }

    assert!(wrong.is_empty(), "circles are among\n{}", wrong.join("\n"));
}

/// Oracle: the table at the top of this file.
#[test]
fn formats_and_the_outside_world_have_one_home() {
    let mut wrong = Vec::new();
    for rules in CRATES {
        for Source { module, path, text } in rules.sources() {
            for (number, line) in code(&text) {
                for (what, homes) in rules.reserved.iter().copied().flatten() {
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
