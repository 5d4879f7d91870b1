//! A report of sections, tables and pictures. It is rendered as Markdown with separate picture
//! files, or as one HTML file with embedded pictures.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};

use super::table::{Table, escaped};

/// A report.
#[derive(Debug, Clone, Default)]
pub struct Document {
    /// Its title.
    pub title: String,
    /// Sections, in order.
    pub sections: Vec<Section>,
}

/// A part with a heading.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Section {
    /// Its heading.
    pub title: String,
    /// Paragraphs, tables and pictures, in order.
    pub blocks: Vec<Block>,
}

/// A piece of a section.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub enum Block {
    /// A paragraph, plain text.
    Text(String),
    /// A table.
    Table(Table),
    /// A picture.
    Picture(Picture),
}

/// A picture.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Picture {
    /// Its file name, which ends with `.svg` or `.png`.
    pub name: String,
    /// The bytes of the SVG or PNG file.
    #[serde(with = "base64_bytes")]
    pub bytes: Vec<u8>,
    /// The caption, which is also the alternative text.
    pub caption: String,
}

/// Bytes as text in JSON.
mod base64_bytes {
    use base64::Engine;
    use base64::engine::general_purpose::STANDARD;
    use serde::{Deserialize, Deserializer, Serializer};

    pub fn serialize<S: Serializer>(bytes: &[u8], to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(&STANDARD.encode(bytes))
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<u8>, D::Error> {
        let text = String::deserialize(from)?;
        STANDARD.decode(text).map_err(serde::de::Error::custom)
    }
}

impl Section {
    /// An empty section.
    pub fn new(title: impl Into<String>) -> Self {
        Self {
            title: title.into(),
            blocks: Vec::new(),
        }
    }

    /// Adds a paragraph.
    pub fn text(&mut self, text: impl Into<String>) {
        self.blocks.push(Block::Text(text.into()));
    }

    /// Adds a table.
    pub fn table(&mut self, table: Table) {
        self.blocks.push(Block::Table(table));
    }

    /// Adds a picture.
    pub fn picture(&mut self, name: impl Into<String>, bytes: Vec<u8>, caption: impl Into<String>) {
        self.blocks.push(Block::Picture(Picture {
            name: name.into(),
            bytes,
            caption: caption.into(),
        }));
    }
}

impl Document {
    /// Every picture of the report, in order.
    pub fn pictures(&self) -> impl Iterator<Item = &Picture> {
        self.sections
            .iter()
            .flat_map(|section| &section.blocks)
            .filter_map(|block| match block {
                Block::Picture(picture) => Some(picture),
                _ => None,
            })
    }

    /// Every table of the report with a file name without extension: the number of its section, the
    /// number of the table in the section, and the words of the section's title.
    pub fn tables(&self) -> impl Iterator<Item = (String, &Table)> {
        (1..).zip(&self.sections).flat_map(|(number, section)| {
            let words = file_words(&section.title);
            let tables = section.blocks.iter().filter_map(|block| match block {
                Block::Table(table) => Some(table),
                _ => None,
            });
            let name = move |place: usize| format!("{number:02}-{place}-{words}");
            (1..)
                .zip(tables)
                .map(move |(place, table)| (name(place), table))
        })
    }

    /// The report as Markdown. Links to pictures point into `folder`, a path relative to the
    /// Markdown file; an empty `folder` is the folder of that file.
    pub fn markdown(&self, folder: &str) -> String {
        let mut text = format!("# {}\n", self.title);
        for section in &self.sections {
            text.push_str(&format!("\n## {}\n", section.title));

            for block in &section.blocks {
                text.push('\n');

                match block {
                    Block::Text(paragraph) => text.push_str(&format!("{paragraph}\n")),
                    Block::Table(table) => text.push_str(&table.markdown()),
                    Block::Picture(Picture { name, caption, .. }) => {
                        let path = if folder.is_empty() {
                            name.clone()
                        } else {
                            format!("{folder}/{name}")
                        };
                        text.push_str(&format!("![{caption}]({path})\n"));
                    }
                }
            }
        }

        text
    }

    /// The report as one self-contained HTML file with embedded pictures.
    pub fn html(&self) -> String {
        let mut body = format!("<h1>{}</h1>\n", escaped(&self.title));
        for section in &self.sections {
            body.push_str(&format!("<h2>{}</h2>\n", escaped(&section.title)));

            for block in &section.blocks {
                match block {
                    Block::Text(paragraph) => {
                        body.push_str(&format!("<p>{}</p>\n", escaped(paragraph)))
                    }
                    Block::Table(table) => body.push_str(&table.html()),
                    Block::Picture(Picture {
                        name,
                        bytes,
                        caption,
                    }) => {
                        let kind = if name.ends_with(".svg") {
                            "svg+xml"
                        } else {
                            "png"
                        };

                        // A data URI puts the picture into the page itself.
                        let data = STANDARD.encode(bytes);
                        let caption = escaped(caption);
                        body.push_str(&format!(
                            "<figure><img alt=\"{caption}\" src=\"data:image/{kind};base64,{data}\">\
                             <figcaption>{caption}</figcaption></figure>\n"
                        ));
                    }
                }
            }
        }

        let title = escaped(&self.title);
        format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{title}</title>\
             <style>{STYLE}</style></head>\n<body>\n{body}</body></html>\n"
        )
    }
}

/// The first words of a title as part of a file name: ASCII letters and digits, joined by hyphens.
fn file_words(title: &str) -> String {
    const WORDS: usize = 4;
    let words = title.split(|letter: char| !letter.is_ascii_alphanumeric());
    let words: Vec<String> = words
        .filter(|word| !word.is_empty())
        .take(WORDS)
        .map(str::to_ascii_lowercase)
        .collect();
    words.join("-")
}

const STYLE: &str = "body{font:16px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem}\
table{border-collapse:collapse;margin:1rem 0;font-variant-numeric:tabular-nums}\
th,td{border-bottom:1px solid #ccc;padding:.2rem .6rem;text-align:right}\
th:first-child,td:first-child{text-align:left}figure{margin:1rem 0}img{max-width:100%}figcaption{color:#555}";

#[cfg(test)]
mod tests {
    use super::*;

    fn document() -> Document {
        let mut section = Section::new("R² < 0?");
        section.text("5 > 3 & so on");

        let mut table = Table::new("a|b | n");
        table.row("x", ["1".to_owned()]);
        section.table(table);

        section.picture("p.svg", b"<svg/>".to_vec(), "A \"curve\"");

        Document {
            title: "T".to_owned(),
            sections: vec![section],
        }
    }

    /// Oracle: the two formats by hand.
    #[test]
    fn a_document_is_written_in_both_formats() {
        let markdown = document().markdown("pictures");
        assert!(
            markdown.contains("| a\\|b | n |\n| --- | ---: |\n| x | 1 |"),
            "{markdown}"
        );

        assert!(
            markdown.contains("![A \"curve\"](pictures/p.svg)"),
            "{markdown}"
        );

        let html = document().html();
        assert!(
            html.contains("<h2>R² &lt; 0?</h2>") && html.contains("<p>5 &gt; 3 &amp; so on</p>"),
            "{html}"
        );

        // echo -n '<svg/>' | base64
        assert!(
            html.contains("data:image/svg+xml;base64,PHN2Zy8+")
                && html.contains("A &quot;curve&quot;"),
            "{html}"
        );

        assert!(!html.contains("p.svg"), "the file is self-contained");
    }

    /// Oracle: the naming rule, by hand.
    #[test]
    fn tables_have_file_names() {
        let document = document();
        let (name, table) = document.tables().next().unwrap();
        assert_eq!(name, "01-1-r-0");
        assert_eq!(table.csv(), "a|b,n\nx,1\n");
        assert_eq!(
            file_words("M4: the adapter by stride, within a room"),
            "m4-the-adapter-by"
        );
    }
}
