//! The rooms of a crate: its top-level modules, and which of them use which.
//!
//! Two checks: what a room of `boot-core` may use, so that a format cannot reach the flash and the
//! programmer knows no object; and that no rooms of a crate use each other in a circle.

use std::collections::{BTreeMap, BTreeSet};

/// What a room may use, of its own crate.
struct Rule {
    room: &'static str,
    may_use: &'static [&'static str],
}

/// The rooms of `boot-core`. A new one needs a row.
const BOOT_CORE: &[Rule] = &[
    Rule { room: "crc", may_use: &[] },
    Rule { room: "flash", may_use: &["crc"] },
    Rule { room: "sequence", may_use: &["flash"] },
    Rule { room: "store", may_use: &["crc", "flash", "sequence"] },
    Rule { room: "program", may_use: &["crc", "flash", "store"] },
    Rule { room: "decision", may_use: &["program"] },
    Rule { room: "queue", may_use: &[] },
    Rule { room: "refusal", may_use: &[] },
    Rule { room: "policy", may_use: &["crc"] },
    Rule { room: "session", may_use: &["policy", "refusal"] },
    // Bytes in, judged and placed pieces out: no flash, no store, no command.
    Rule { room: "intake", may_use: &["policy", "program", "queue", "refusal", "session"] },
    // Pieces and addresses: no format, no object.
    Rule { room: "programmer", may_use: &["crc", "flash", "program", "queue", "sequence", "store"] },
    Rule {
        room: "control",
        may_use: &["flash", "intake", "policy", "program", "programmer", "refusal", "session", "store"],
    },
    Rule { room: "stored_version", may_use: &["flash", "programmer"] },
    Rule { room: "bootloader", may_use: &["control", "decision", "flash", "store", "stored_version"] },
    Rule { room: "profile", may_use: &["bootloader", "policy"] },
];

/// The crates that are checked for circles. Of the others the knots are known: `coflash` (flash,
/// dialect, session, info, error, lss, scan), `emulator` (cpu, machine).
pub const WITHOUT_CIRCLES: &[&str] =
    &["bootloader", "boot-core", "canopen", "coboot-node", "shared-abi", "xtask"];

/// Which room uses which.
pub type Graph = BTreeMap<String, BTreeSet<String>>;

/// Reads the graph off the sources of a crate: the path of each below `src/`, and its text.
pub fn graph(sources: &[(String, String)]) -> Graph {
    let room = |path: &str| path.split('/').next().unwrap_or_default().trim_end_matches(".rs").to_owned();
    let is_root = |name: &str| matches!(name, "lib" | "main" | "bin");
    let mut graph = Graph::new();
    for (path, _) in sources {
        if !is_root(&room(path)) {
            graph.entry(room(path)).or_default();
        }
    }
    let rooms: BTreeSet<_> = graph.keys().cloned().collect();
    for (path, text) in sources {
        let own = room(path);
        // What tests use is theirs.
        let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
        for line in code.lines().filter(|line| !line.trim_start().starts_with("//")) {
            for used in line.split("crate::").skip(1) {
                let name: String = used.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                if rooms.contains(&name) && name != own {
                    if let Some(uses) = graph.get_mut(&own) {
                        uses.insert(name);
                    }
                }
            }
        }
    }
    graph
}

/// A circle in the graph, if there is one: each room uses the next, and the last one the first.
pub fn circle(graph: &Graph) -> Option<Vec<String>> {
    fn walk(
        graph: &Graph,
        at: &str,
        path: &mut Vec<String>,
        done: &mut BTreeSet<String>,
    ) -> Option<Vec<String>> {
        if let Some(from) = path.iter().position(|room| room == at) {
            return Some(path[from..].to_vec());
        }
        if !done.insert(at.to_owned()) {
            return None;
        }
        path.push(at.to_owned());
        let found = graph.get(at)?.iter().find_map(|used| walk(graph, used, path, done));
        path.pop();
        found
    }
    let mut done = BTreeSet::new();
    graph.keys().find_map(|room| walk(graph, room, &mut Vec::new(), &mut done))
}

/// What is wrong with the rooms of a crate, in words.
pub fn broken(name: &str, graph: &Graph) -> Vec<String> {
    let mut broken = Vec::new();
    if let Some(circle) = circle(graph).filter(|_| WITHOUT_CIRCLES.contains(&name)) {
        broken.push(format!("{name}: these modules use each other in a circle: {}", circle.join(" -> ")));
    }
    if name != "boot-core" {
        return broken;
    }
    for (room, uses) in graph {
        let Some(rule) = BOOT_CORE.iter().find(|rule| rule.room == room) else {
            broken.push(format!("{name}: the module {room} has no rule"));
            continue;
        };
        for used in uses.iter().filter(|used| !rule.may_use.contains(&used.as_str())) {
            broken.push(format!("{name}: {room} uses {used}, which it may not"));
        }
    }
    broken
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sources(files: &[(&str, &str)]) -> Vec<(String, String)> {
        files.iter().map(|(path, text)| ((*path).to_owned(), (*text).to_owned())).collect()
    }

    #[test]
    fn a_room_uses_what_its_files_name_outside_comments_and_tests() {
        let graph = graph(&sources(&[
            ("lib.rs", "mod a; use crate::a::X;"),
            ("a/mod.rs", "use crate::b::Y;\n// crate::c\nfn f() { crate::a::g() }"),
            (
                "a/deep.rs",
                "fn f() { crate::d::g(crate::e::h()) }\n#[cfg(test)]\nmod tests { use crate::c::Z; }",
            ),
            ("b.rs", ""),
            ("c.rs", ""),
            ("d.rs", ""),
            ("e.rs", ""),
        ]));
        let uses: Vec<_> = graph["a"].iter().map(String::as_str).collect();
        assert_eq!(uses, ["b", "d", "e"]);
        assert!(!graph.contains_key("lib"));
    }

    #[test]
    fn a_circle_is_found_however_long_and_a_diamond_is_none() {
        let graph_of = |arrows: &[(&str, &str)]| {
            let mut graph = Graph::new();
            for (from, to) in arrows {
                graph.entry((*to).to_owned()).or_default();
                graph.entry((*from).to_owned()).or_default().insert((*to).to_owned());
            }
            graph
        };
        assert_eq!(circle(&graph_of(&[("a", "b"), ("a", "c"), ("b", "d"), ("c", "d")])), None);
        let found = circle(&graph_of(&[("x", "a"), ("a", "b"), ("b", "c"), ("c", "a")])).unwrap();
        assert_eq!(found, ["a", "b", "c"]);
    }

    #[test]
    fn a_format_that_reaches_for_the_flash_is_told() {
        let graph = graph(&sources(&[("intake/raw.rs", "use crate::flash::Flash;"), ("flash.rs", "")]));
        assert_eq!(broken("boot-core", &graph), ["boot-core: intake uses flash, which it may not"]);
        assert_eq!(broken("coflash", &graph), [""; 0]);
    }
}
