//! Figures as files: SVG as it is drawn, PNG and PDF made of it.

use std::path::Path;

use anyhow::{Result, bail};

use crate::atomic;

/// How a figure is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    Svg,
    Png,
    Pdf,
}

impl Form {
    fn of(path: &Path) -> Result<Self> {
        let ending = path.extension().and_then(|ending| ending.to_str());
        let form = match ending.map(str::to_ascii_lowercase).as_deref() {
            Some("svg") => Self::Svg,
            Some("png") => Self::Png,
            Some("pdf") => Self::Pdf,
            _ => bail!(
                "{}: expected a name that ends in .svg, .png or .pdf",
                path.display()
            ),
        };
        if form != Self::Svg && !cfg!(feature = "figures") {
            bail!(
                "{}: this build draws SVG only; PNG and PDF need `--features figures`",
                path.display()
            );
        }
        Ok(form)
    }
}

/// Refuses a name that no figure can have, before anything is computed.
pub(crate) fn check(path: &Path) -> Result<()> {
    Form::of(path).map(|_| ())
}

/// Writes an SVG document in the form that the file's ending says.
pub(crate) fn write(path: &Path, svg: &str) -> Result<()> {
    let bytes = match Form::of(path)? {
        Form::Svg => svg.as_bytes().to_vec(),
        #[cfg(feature = "figures")]
        Form::Png => rendered::png(svg)?,
        #[cfg(feature = "figures")]
        Form::Pdf => rendered::pdf(svg)?,
        #[cfg(not(feature = "figures"))]
        Form::Png | Form::Pdf => bail!("this build draws SVG only"),
    };
    atomic::write(path, &bytes)
}

/// SVG in other forms. Text is set in a font of the machine: another machine may set it in another.
#[cfg(feature = "figures")]
mod rendered {
    use anyhow::{Context as _, Result, anyhow, bail};
    use resvg::tiny_skia::{Pixmap, Transform};
    use resvg::usvg;

    /// Pixels of a PNG per pixel of the drawing: 192 to the inch.
    const SCALE: f32 = 2.0;
    /// What stands for `sans-serif`, the first that is there.
    const FONTS: [&str; 6] = [
        "DejaVu Sans",
        "Liberation Sans",
        "Noto Sans",
        "Arial",
        "Helvetica",
        "Segoe UI",
    ];

    fn tree(svg: &str) -> Result<usvg::Tree> {
        let mut options = usvg::Options::default();
        let fonts = options.fontdb_mut();
        fonts.load_system_fonts();
        let has = |name: &str| {
            let mut families = fonts.faces().flat_map(|face| &face.families);
            families.any(|(family, _)| family == name)
        };
        let Some(name) = FONTS.into_iter().find(|name| has(name)) else {
            bail!(
                "found none of the fonts {}: install one, or write SVG",
                FONTS.join(", ")
            );
        };
        fonts.set_sans_serif_family(name);
        usvg::Tree::from_str(svg, &options).context("cannot read the drawing")
    }

    pub(super) fn png(svg: &str) -> Result<Vec<u8>> {
        let tree = tree(svg)?;
        let size = tree.size();
        let [width, height] =
            [size.width(), size.height()].map(|side| (side * SCALE).ceil() as u32);
        let pixels = Pixmap::new(width, height);
        let mut pixels =
            pixels.with_context(|| format!("{width} × {height} pixels are no picture"))?;
        resvg::render(
            &tree,
            Transform::from_scale(SCALE, SCALE),
            &mut pixels.as_mut(),
        );
        pixels.encode_png().context("cannot encode the picture")
    }

    pub(super) fn pdf(svg: &str) -> Result<Vec<u8>> {
        let tree = tree(svg)?;
        let (conversion, page) = (
            svg2pdf::ConversionOptions::default(),
            svg2pdf::PageOptions::default(),
        );
        svg2pdf::to_pdf(&tree, conversion, page).map_err(|error| anyhow!("{error:?}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ending_says_the_form() {
        assert_eq!(Form::of(Path::new("a.svg")).unwrap(), Form::Svg);
        let error = Form::of(Path::new("a.gif")).unwrap_err().to_string();
        assert!(error.contains(".svg, .png or .pdf"), "{error}");
        let png = Form::of(Path::new("a.PNG"));
        assert_eq!(png.is_ok(), cfg!(feature = "figures"));
    }

    #[cfg(feature = "figures")]
    #[test]
    fn pictures_and_pages_are_the_same_every_time() {
        let svg = r##"<svg xmlns="http://www.w3.org/2000/svg" width="40" height="20" font-family="sans-serif"><rect width="40" height="20" fill="#fff"/><text x="2" y="14" font-size="10">d/√d</text></svg>"##;
        let folder = tempfile::tempdir().unwrap();
        for (ending, magic) in [("png", &b"\x89PNG"[..]), ("pdf", &b"%PDF"[..])] {
            let path = folder.path().join(format!("a.{ending}"));
            let mut seen = Vec::new();
            for _ in 0..2 {
                write(&path, svg).unwrap();
                seen.push(std::fs::read(&path).unwrap());
            }
            assert!(seen[0].starts_with(magic));
            assert_eq!(seen[0], seen[1]);
        }
    }
}
