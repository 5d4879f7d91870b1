//! The architecture, enforced: `src/lib.rs` lists the modules bottom to top, and each uses only
//! those above its line.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The longest source file.
const LONGEST_FILE: usize = 400;
/// Crates and modules that only some of ours may name: (what, who).
const RESERVED: [(&str, &[&str]); 14] = [
    ("mcap", &["report"]),
    ("parquet", &["report"]),
    ("ort", &["encoder"]),
    ("tract_onnx", &["encoder"]),
    ("fast_image_resize", &["encoder"]),
    ("tonic", &["proto", "service", "client", "cli"]),
    ("prost", &["proto", "service", "encoder"]),
    ("tokio", &["service", "client", "cli", "main"]),
    ("std::fs", &["datasets", "encoder", "store", "cli"]),
    ("std::env", &[]),
    ("std::time", &["service", "client", "cli", "main"]),
    ("hnsw_rs", &["index"]),
    ("object_store", &["store"]),
    ("serde", &["datasets", "store", "report", "cli"]),
];

fn source() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src")
}

/// Modules of lib.rs in order, bottom first.
fn modules() -> Vec<String> {
    let lib = std::fs::read_to_string(source().join("lib.rs")).unwrap();
    let name = |line: &str| Some(line.strip_prefix("pub mod ")?.split(';').next()?.to_owned());
    lib.lines().filter_map(name).collect()
}

fn files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// Every source file with the module of lib.rs that it belongs to.
fn sources() -> Vec<(String, PathBuf, String)> {
    let mut paths = Vec::new();
    files(&source(), &mut paths);

    let module = |path: &Path| {
        let first = path
            .strip_prefix(source())
            .unwrap()
            .components()
            .next()
            .unwrap();
        first
            .as_os_str()
            .to_string_lossy()
            .trim_end_matches(".rs")
            .to_owned()
    };

    paths
        .into_iter()
        .map(|path| {
            (
                module(&path),
                path.clone(),
                std::fs::read_to_string(path).unwrap(),
            )
        })
        .collect()
}

/// The code of a file: no comments, and nothing of its unit tests.
fn code(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let tests = text.find("#[cfg(test)]").unwrap_or(text.len());
    text[..tests]
        .lines()
        .enumerate()
        .map(|(number, line)| (number + 1, line.split("//").next().unwrap_or("")))
}

/// Oracle: the list in lib.rs.
#[test]
fn a_module_uses_only_those_above_it() {
    let order: BTreeMap<String, usize> = modules()
        .into_iter()
        .enumerate()
        .map(|(i, name)| (name, i))
        .collect();

    assert!(order.len() > 15, "lib.rs lists the modules");

    let mut wrong = Vec::new();
    for (module, path, text) in sources() {
        let Some(&place) = order.get(&module) else {
            assert!(
                ["lib", "main"].contains(&module.as_str()),
                "{} is not in lib.rs",
                path.display()
            );

            continue;
        };

        for (number, line) in code(&text) {
            for used in line.split("crate::").skip(1) {
                let braces = used.trim_start_matches('{');
                let names: Vec<&str> = if used.starts_with('{') {
                    braces
                        .split('}')
                        .next()
                        .unwrap_or("")
                        .split(',')
                        .map(str::trim)
                        .collect()
                } else {
                    vec![braces]
                };

                for name in names {
                    let name: String = name
                        .chars()
                        .take_while(|c| c.is_alphanumeric() || *c == '_')
                        .collect();

                    if order.get(&name).is_some_and(|&other| other > place) {
                        wrong.push(format!(
                            "{}:{number} uses {name}, which stands below it",
                            path.display()
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
    for (module, path, text) in sources() {
        for (number, line) in code(&text) {
            for (what, homes) in RESERVED {
                let named = line.match_indices(what).any(|(at, _)| {
                    let before = line[..at].chars().next_back();
                    let after = line[at + what.len()..].chars().next();
                    let apart = |c: Option<char>| {
                        c.is_none_or(|c| !c.is_alphanumeric() && !"_-,\"".contains(c))
                    };

                    apart(before) && apart(after)
                });

                let home = homes.contains(&module.as_str()) || (module == "lib");
                if named && !home {
                    wrong.push(format!("{}:{number} names {what}", path.display()));
                }
            }
        }
    }

    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Oracle: the style guide: a header, at most 400 lines, no unwrap outside tests.
#[test]
fn files_have_a_header_and_one_idea() {
    for (_, path, text) in sources() {
        assert!(text.starts_with("//! "), "{} has no header", path.display());

        let lines = text.lines().count();
        assert!(
            lines <= LONGEST_FILE,
            "{} has {lines} lines, split it by idea",
            path.display()
        );

        for (number, line) in code(&text) {
            let panics = [
                ".unwrap()",
                ".expect(",
                "todo!(",
                "unimplemented!(",
                "dbg!(",
                "panic!(",
            ];

            let found = panics.iter().find(|word| line.contains(*word));
            assert!(
                found.is_none(),
                "{}:{number} has {}",
                path.display(),
                found.unwrap()
            );
        }
    }
}
