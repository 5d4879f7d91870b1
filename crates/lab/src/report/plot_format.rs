//! Plots as PDF and PNG files.
//!
//! Plots are made as SVG. Their text is set in a font that is part of the program, so that a file
//! looks the same on every machine, also on one without fonts.

use std::sync::Arc;

use resvg::tiny_skia::{Pixmap, Transform};

use super::Error;

/// Pixels of a PNG file per pixel of the SVG.
const PNG_SCALE: f32 = 2.0;

/// Converts an SVG plot to a PDF file of one page: a pixel of the SVG is 1/72 inch, and text is
/// drawn as outlines.
///
/// # Errors
/// [`Error::Picture`] if the SVG cannot be read.
pub fn plot_pdf(svg: &[u8]) -> Result<Vec<u8>, Error> {
    pdf(svg, svg2pdf::ConversionOptions::default())
}

fn pdf(svg: &[u8], options: svg2pdf::ConversionOptions) -> Result<Vec<u8>, Error> {
    let outlines = read(svg)?.to_string(&usvg::WriteOptions::default());

    let tree = svg2pdf::usvg::Tree::from_str(&outlines, &svg2pdf::usvg::Options::default())
        .map_err(picture)?;
    svg2pdf::to_pdf(&tree, options, svg2pdf::PageOptions::default()).map_err(picture)
}

/// Converts an SVG plot to a PNG file of twice its width and height in pixels.
///
/// # Errors
/// [`Error::Picture`] if the SVG cannot be read.
pub fn plot_png(svg: &[u8]) -> Result<Vec<u8>, Error> {
    let tree = read(svg)?;
    let side = |length: f32| (length * PNG_SCALE).ceil() as u32;
    let size = (side(tree.size().width()), side(tree.size().height()));
    let mut pixels = Pixmap::new(size.0, size.1).ok_or_else(|| picture("it has no pixels"))?;

    let scale = Transform::from_scale(PNG_SCALE, PNG_SCALE);
    resvg::render(&tree, scale, &mut pixels.as_mut());
    pixels.encode_png().map_err(picture)
}

fn read(svg: &[u8]) -> Result<usvg::Tree, Error> {
    let mut fonts = usvg::fontdb::Database::new();
    fonts.load_font_data(epaint_default_fonts::UBUNTU_LIGHT.to_vec());
    // It has the signs that the other one lacks, such as ‖ and →.
    fonts.load_font_data(epaint_default_fonts::HACK_REGULAR.to_vec());
    let family = fonts.faces().next().map(|face| face.families[0].0.clone());
    fonts.set_sans_serif_family(family.unwrap_or_default());

    let options = usvg::Options {
        fontdb: Arc::new(fonts),
        ..usvg::Options::default()
    };
    usvg::Tree::from_data(svg, &options).map_err(picture)
}

fn picture(problem: impl ToString) -> Error {
    Error::Picture {
        problem: problem.to_string().into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A red rectangle, and a word above it on white.
    const SVG: &[u8] =
        br##"<svg width="100" height="60" viewBox="0 0 100 60" xmlns="http://www.w3.org/2000/svg">
        <rect x="0" y="0" width="100" height="60" fill="#FFFFFF"/>
        <rect x="20" y="30" width="40" height="20" fill="#FF0000"/>
        <text x="20" y="20" font-family="sans-serif" font-size="16" fill="#000000">Hit</text>
    </svg>"##;

    /// Oracle: the coordinates of the SVG, doubled.
    #[test]
    fn a_png_has_twice_the_pixels_and_its_text() {
        let image = image::load_from_memory(&plot_png(SVG).unwrap())
            .unwrap()
            .to_rgb8();
        assert_eq!(image.dimensions(), (200, 120));

        for (x, y, expected) in [
            (42, 62, [255, 0, 0]),
            (118, 98, [255, 0, 0]),
            (38, 62, [255; 3]),
            (122, 98, [255; 3]),
            (190, 10, [255; 3]),
        ] {
            assert_eq!(image.get_pixel(x, y).0, expected, "{x}, {y}");
        }

        let is_ink = |x: u32, y: u32| image.get_pixel(x, y).0.iter().all(|&level| level < 128);
        let ink = (0..200)
            .flat_map(|x| (0..50).map(move |y| (x, y)))
            .filter(|&(x, y)| is_ink(x, y));
        let columns: Vec<u32> = ink.map(|(x, _)| x).collect();
        assert!(columns.len() > 50, "{} dark pixels", columns.len());
        assert!(columns.iter().all(|x| (40..100).contains(x)), "{columns:?}");
    }

    /// Oracle: the operators of PDF: the rectangle's color, and curves or lines of the text; a page
    /// as large as the SVG.
    #[test]
    fn a_pdf_has_the_shapes_and_the_text_as_outlines() {
        let plain = svg2pdf::ConversionOptions {
            compress: false,
            ..svg2pdf::ConversionOptions::default()
        };
        let with_text = String::from_utf8_lossy(&pdf(SVG, plain).unwrap()).into_owned();
        assert!(with_text.starts_with("%PDF-1."));
        assert!(with_text.contains("/MediaBox [0 0 100 60]"), "{with_text}");
        assert!(
            with_text.contains("1 0 0 scn") || with_text.contains("1 0 0 rg"),
            "{with_text}"
        );

        let svg = String::from_utf8(SVG.to_vec())
            .unwrap()
            .replace(">Hit<", "><");
        let without = pdf(svg.as_bytes(), plain).unwrap();
        let shapes = |text: &str| text.lines().filter(|line| line.ends_with(" m")).count();
        let without = shapes(&String::from_utf8_lossy(&without));
        // H has one outline, i two, t one.
        assert_eq!(shapes(&with_text), without + 4);
    }

    #[test]
    fn what_is_no_svg_is_refused() {
        assert!(plot_pdf(b"plot").is_err() && plot_png(b"plot").is_err());
    }
}
