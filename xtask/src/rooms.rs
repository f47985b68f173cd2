//! The rooms of a crate: its top-level modules, and which of them use which.
//!
//! Two checks: the permitted uses of each room of `boot-core` and of `coflash-core`, so that a format
//! cannot reach the flash and a file does not depend on a device; and that in no crate rooms or files
//! use each other in a circle.

use std::collections::{BTreeMap, BTreeSet};

use crate::modules;

/// The rooms of its own crate that a room may use.
type Rule = (&'static str, &'static str);

/// The rooms of `boot-core`. A new room needs a row.
const BOOT_CORE: &[Rule] = &[
    ("choices", "decision"),
    ("crc", ""),
    ("flash", "crc"),
    ("sequence", "flash"),
    ("store", "crc flash resume sequence"),
    ("program", "crc flash keys store"),
    ("decision", "crc flash program renewal store"),
    ("keys", "flash store"),
    ("queue", "session"),
    ("refusal", ""),
    ("renewal", "flash store"),
    ("resume", ""),
    // A product's check reads block 0 where its data wait.
    ("policy", "crc keys queue refusal resume session"),
    ("session", ""),
    // It turns bytes into judged pieces with an address: no flash, no store, no command.
    ("intake", "choices keys policy program queue refusal resume session"),
    // It works from the queue to the flash: no session, no object.
    ("unseal", "flash keys policy program queue renewal store"),
    ("source", "flash program queue store unseal"),
    // It works on pieces and addresses: no format, no object.
    ("programmer", "choices crc flash policy program queue renewal resume sequence source store"),
    (
        "control",
        "choices decision flash intake keys policy program programmer refusal renewal resume session source store unseal",
    ),
    ("stored_version", "flash programmer"),
    ("bootloader", "choices control decision flash resume store stored_version"),
    ("profile", "choices policy"),
];

/// The rooms of `coflash-core`. A new room needs a row. `update` uses `coboot_can` for several devices at
/// once, which share an adapter.
const COFLASH: &[Rule] = &[
    ("options", ""),
    ("unicode", ""),
    ("json", "canopen"),
    ("advice", "canopen"),
    ("file", "advice options shared_abi unicode"),
    ("device", "advice canopen coboot_can json options shared_abi unicode"),
    ("update", "advice canopen coboot_can device file json options shared_abi"),
    ("machine", "canopen coboot_can device file json options shared_abi update"),
];

/// The dependencies of `coflash-core` that a room may use only if its row lists them.
const OURS: [&str; 3] = ["canopen", "coboot_can", "shared_abi"];

/// For each room, those that it uses.
type Graph = BTreeMap<String, BTreeSet<String>>;

/// The graph of the rooms, from the graph of all files. Uses by the root are left out.
fn graph(files: &modules::Graph) -> Graph {
    let mut graph = Graph::new();
    for (file, uses) in files {
        let Some(own) = file.first() else { continue };
        let room = graph.entry(own.clone()).or_default();
        room.extend(uses.iter().filter_map(|used| used.first()).filter(|used| *used != own).cloned());
    }
    graph
}

/// For each room, the crates of [`OURS`] that it names.
fn crates(sources: &[(String, String)]) -> Graph {
    let mut graph = Graph::new();
    for (path, text) in sources {
        let room = path.split('/').next().unwrap_or_default().trim_end_matches(".rs");
        let names = modules::paths(&modules::code(text));
        let ours = names.iter().filter_map(|path| path.first()).filter(|name| OURS.contains(&name.as_str()));
        graph.entry(room.to_owned()).or_default().extend(ours.cloned());
    }
    graph
}

/// A circle in the graph, if there is one: each node uses the next one, and the last one the first.
fn circle<T: Clone + Ord>(graph: &BTreeMap<T, BTreeSet<T>>) -> Option<Vec<T>> {
    fn walk<T: Clone + Ord>(
        graph: &BTreeMap<T, BTreeSet<T>>,
        at: &T,
        path: &mut Vec<T>,
        done: &mut BTreeSet<T>,
    ) -> Option<Vec<T>> {
        if let Some(from) = path.iter().position(|node| node == at) {
            return Some(path[from..].to_vec());
        }
        if !done.insert(at.clone()) {
            return None;
        }
        path.push(at.clone());
        let found = graph.get(at)?.iter().find_map(|used| walk(graph, used, path, done));
        path.pop();
        found
    }
    let mut done = BTreeSet::new();
    graph.keys().find_map(|node| walk(graph, node, &mut Vec::new(), &mut done))
}

/// The faults in the modules of a crate, as messages. `sources` are the path of each file below
/// `src/`, and its text.
pub fn broken(name: &str, sources: &[(String, String)]) -> Vec<String> {
    let files = modules::graph(name, sources);
    let mut rooms = graph(&files);
    let mut broken = Vec::new();
    if let Some(circle) = circle(&rooms) {
        broken.push(format!("{name}: these modules use each other in a circle: {}", circle.join(" -> ")));
    } else if let Some(circle) = circle(&files) {
        let names = circle.iter().map(|file| if file.is_empty() { "(root)".into() } else { file.join("::") });
        let names: Vec<String> = names.collect();
        broken.push(format!("{name}: these files use each other in a circle: {}", names.join(" -> ")));
    }
    let rules = match name {
        "boot-core" => BOOT_CORE,
        "coflash-core" => {
            for (room, uses) in crates(sources) {
                // What is in no room is the root.
                rooms.entry(room).and_modify(|all| all.extend(uses));
            }
            COFLASH
        }
        _ => return broken,
    };
    for (room, uses) in &rooms {
        let Some((_, may_use)) = rules.iter().find(|(name, _)| name == room) else {
            broken.push(format!("{name}: the module {room} has no rule"));
            continue;
        };
        for used in uses.iter().filter(|used| !may_use.split(' ').any(|name| name == *used)) {
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
        let sources = sources(&[("intake/raw.rs", "use crate::flash::Flash;"), ("flash.rs", "")]);
        assert_eq!(broken("boot-core", &sources), ["boot-core: intake uses flash, which it may not"]);
        assert_eq!(broken("emulator", &sources), [""; 0]);
    }

    #[test]
    fn each_wall_of_coflash_holds() {
        for (file, text, words) in [
            ("file/elf.rs", "use canopen::NodeId;", "file uses canopen, which it may not"),
            ("file/elf.rs", "fn f() { coboot_can::open() }", "file uses coboot_can, which it may not"),
            ("file/elf.rs", "fn f() { super::super::device::info() }", "file uses device, which it may not"),
            ("device/info.rs", "use crate::update::flash;", "device uses update, which it may not"),
            ("attic.rs", "", "the module attic has no rule"),
        ] {
            let mut all = sources(&[("device/mod.rs", ""), ("update/mod.rs", "")]);
            all.push((file.to_owned(), text.to_owned()));
            assert_eq!(broken("coflash-core", &all), [format!("coflash-core: {words}")], "{file}: {text}");
        }
    }

    #[test]
    fn modules_and_files_that_use_each_other_are_told_in_every_crate() {
        let room = [
            ("device/mod.rs", "pub use self::hub::Hub;"),
            ("device/hub.rs", "use super::{port::Port, adapter::Adapter};"),
            ("device/port.rs", "use crate::device::hub;"),
            ("device/adapter.rs", ""),
        ];
        let rooms = [
            ("a/mod.rs", ""),
            ("a/one.rs", "use crate::b::X;"),
            ("a/two.rs", ""),
            ("b.rs", "use crate::a::two::Y;"),
        ];
        // The firmware has a second program in a folder of its own.
        let programs = [
            ("main.rs", "mod services;"),
            ("services.rs", ""),
            ("resident/main.rs", "mod stage; mod storing; fn main() { stage::run() }"),
            ("resident/stage.rs", "use crate::services::X;\nuse crate::storing;"),
            ("resident/storing.rs", "use crate::stage::Stage;"),
        ];
        // `main.rs` is a file like others, unless a library beside it is what `crate::` means.
        let main =
            |path| [(path, "mod a; use a::f;"), ("a.rs", "use crate::X;"), ("bin/b/a.rs", "use super::Y;")];
        let with_library = [&main("main.rs")[..], &[("lib.rs", "pub struct X;")]].concat();
        for (krate, files, circle) in [
            ("coflash-core", &room[..], "files use each other in a circle: device::hub -> device::port"),
            ("emulator", &room, "files use each other in a circle: device::hub -> device::port"),
            ("emulator", &rooms, "modules use each other in a circle: a -> b"),
            (
                "bootloader",
                &programs,
                "files use each other in a circle: resident::stage -> resident::storing",
            ),
            ("x", &main("main.rs"), "files use each other in a circle: (root) -> a"),
            ("x", &main("bin/b/main.rs"), "files use each other in a circle: bin::b -> bin::b::a"),
        ] {
            assert_eq!(broken(krate, &sources(files)), [format!("{krate}: these {circle}")]);
        }
        assert_eq!(broken("x", &sources(&with_library)), [""; 0]);
    }

    #[test]
    fn every_rule_speaks_of_rooms_that_have_one() {
        for used in COFLASH.iter().flat_map(|(_, may_use)| may_use.split_terminator(' ')) {
            assert!(OURS.contains(&used) || COFLASH.iter().any(|(room, _)| *room == used), "{used}");
        }
    }
}
