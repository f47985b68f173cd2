//! `cargo xtask diagrams`: draws the graphs of the documents from text.

use std::path::PathBuf;
use std::process::Command;

use sha2::{Digest, Sha256};

use crate::args::Args;
use crate::{files, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask diagrams

Draws each FILE.dot in docs/diagrams as FILE.svg by Graphviz (Debian's package graphviz). The SVG
files are checked in; a test fails if one is older than what it is drawn from. The other pictures are
drawn by hand, and tests compare their numbers.
";

/// The sources.
fn sources() -> Outcome<Vec<PathBuf>> {
    let mut sources = files::within(&workspace::root().join("docs/diagrams"))?;
    sources.retain(|file| files::is(file, "dot"));
    Ok(sources)
}

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    for source in sources()? {
        let drawn = process::output(Command::new("dot").arg("-Tsvg").arg(&source))
            .map_err(|problem| format!("{problem} Graphviz is needed: sudo apt-get install -y graphviz"))?;
        // What is in front changes with the version of Graphviz.
        let from = drawn.find("<svg").ok_or("Graphviz drew no SVG.")?;
        let mark = mark(&files::bytes(&source)?);
        files::write(&source.with_extension("svg"), format!("{mark}\n{}", &drawn[from..]))?;
    }
    Ok(())
}

/// The first line of a picture, with a hash of its source. The sources are compared by it, since
/// pictures of another version of Graphviz differ in every line.
fn mark(source: &[u8]) -> String {
    let hash: String = Sha256::digest(source)[..8].iter().map(|byte| format!("{byte:02x}")).collect();
    format!("<!-- drawn by `cargo xtask diagrams` from {hash} -->")
}

#[cfg(test)]
mod tests {
    use shared_abi::geometry::Region;
    use shared_abi::layout::stm32f407g_disc1::LAYOUT;

    use super::*;

    #[test]
    fn the_pictures_are_those_of_their_sources() {
        let sources = sources().unwrap();
        assert!(sources.len() > 5, "{sources:?}");
        for source in sources {
            let picture = files::text(&source.with_extension("svg")).unwrap();
            let is_new = picture.starts_with(&mark(&files::bytes(&source).unwrap()));
            assert!(is_new, "the picture of {} is old: run `cargo xtask diagrams`", source.display());
        }
    }

    /// Name, address, size and sectors of each region, and no other region.
    #[test]
    fn the_memory_map_shows_every_region() {
        let map = files::ours("docs/diagrams/memory.svg").unwrap();
        let mut texts =
            map.lines().filter_map(|line| line.split_once("weight=\"normal\">")?.1.split('<').next());
        let remark = |region: &Region| {
            let size = match region.size {
                size if size.is_multiple_of(1024) => format!("{} KiB", size / 1024),
                size => format!("{size} B"),
            };
            match (LAYOUT.chip.sector_at(region.base), LAYOUT.chip.sector_at(region.end() - 1)) {
                (Some(a), Some(b)) if a.number == b.number => format!("{size}, sector {}", a.number),
                (Some(a), Some(b)) => format!("{size}, sectors {} to {}", a.number, b.number),
                _ => size,
            }
        };
        let [a, b] = LAYOUT.parameters;
        for (name, region) in [
            ("resident part", LAYOUT.bootloader),
            ("parameters A", a),
            ("parameters B", b),
            ("data", LAYOUT.data.unwrap()),
            ("RAM image", LAYOUT.home.unwrap()),
            ("program 1", LAYOUT.programs[0]),
            ("staging", LAYOUT.staging.unwrap()),
            ("code and data", LAYOUT.ram),
            ("handoff", LAYOUT.handoff),
            ("warm-start cell", LAYOUT.warm_start),
        ] {
            let expected = [name.to_owned(), format!("{:08X}h", region.base), remark(&region)];
            assert_eq!(texts.by_ref().take(3).collect::<Vec<_>>(), expected);
        }
        assert_eq!(texts.next(), None);
    }

    #[test]
    fn the_windows_in_the_picture_are_those_of_the_text() {
        let text = files::ours("docs/pictures/two-windows.txt").unwrap();
        let line = |line: &str| {
            let text = line.strip_prefix("<text")?.split_once('>')?.1.strip_suffix("</text>")?;
            let title = if line.contains("middle") { "== " } else { "" };
            Some(format!("{title}{}", text.replace("&lt;", "<").replace("&amp;", "&")))
        };
        let drawn: Vec<_> =
            files::ours("docs/pictures/two-windows.svg").unwrap().lines().filter_map(line).collect();
        assert_eq!(drawn, text.lines().collect::<Vec<_>>());
    }

    /// The times in the remark of the picture: 640 pixels for 24 ms, from -2 ms on, after 96 pixels of
    /// names.
    #[test]
    fn the_way_back_has_its_times_in_their_places() {
        let picture = files::ours("docs/diagrams/way-back.svg").unwrap();
        let x =
            |time: &str| ((96.0 + (time.parse::<f64>().unwrap() + 2.0) / 24.0 * 640.0) * 10.0).round() / 10.0;
        let panels: Vec<&str> = picture.split("\npanel ").skip(1).collect();
        let titles: Vec<&str> = picture.split("font-size=\"13\">").skip(1).collect();
        assert_eq!((panels.len(), titles.len()), (2, 2));
        let mut count = 0;
        for (panel, drawn) in panels.iter().zip(titles) {
            for words in panel.lines().skip(1).map(|line| line.splitn(4, ' ').collect::<Vec<_>>()) {
                match words[..] {
                    [kind @ ("frame" | "bar"), from, to, text] => {
                        let width = ((x(to) - x(from)) * 10.0).round() / 10.0;
                        let height = if kind == "frame" { 16 } else { 38 };
                        let size = format!("width=\"{width}\" height=\"{height}\"");
                        let begin = format!("<rect x=\"{}\" y", x(from));
                        let is_drawn = |line: &str| line.starts_with(&begin) && line.contains(&size);
                        assert!(drawn.lines().any(is_drawn), "{text} {from}");
                        assert!(kind == "bar" || drawn.contains(&format!(">{text}</text>")), "{text}");
                    }
                    ["mark", at, ..] => assert!(drawn.contains(&format!("<line x1=\"{}\"", x(at))), "{at}"),
                    _ => break,
                }
                count += 1;
            }
        }
        assert_eq!(count, 16);
    }
}
