//! The page that compares coboot with others (docs/compare.md) has the figures of today's measurements.

const PAGE: &str = include_str!("../../docs/compare.md");
const BENCH: &str = include_str!("../../docs/bench.md");

/// Each time in the column of coboot is in bench.md, which `cargo xtask bench` makes.
#[test]
fn the_times_of_coboot_are_those_of_the_measurements() {
    let (_, figures) = PAGE.split_once("\n## Figures\n").unwrap();
    let (figures, _) = figures.split_once("\n## ").unwrap();
    let mut count = 0;
    for row in figures.lines().filter_map(|line| line.strip_prefix("| ")) {
        let Some(of_coboot) = row.split(" | ").nth(1) else { continue };
        let words: Vec<&str> = of_coboot.split([' ', ',', ';']).collect();
        for pair in words.windows(2).filter(|pair| ["s", "ms"].contains(&pair[1])) {
            let time = pair.join(" ");
            // The table of starts is in ms.
            let is_there = BENCH.contains(&format!(" {time}"))
                || pair[1] == "ms" && BENCH.contains(&format!("| {} |", pair[0]));
            assert!(is_there, "bench.md has no {time}: {row}");
            count += 1;
        }
    }
    // Four rows with five times of downloads, and two rows with three of others.
    assert_eq!(count, 8, "the page has other times");
}
