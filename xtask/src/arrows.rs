//! `cargo xtask arrows`: checks which crate depends on which.
//!
//! The crates are separated by a few rules. The emulator does not use our drivers, so that a
//! mistake in one does not cancel out in the other. The application does not use `boot-core`, so
//! that it can be replaced. The wire code uses no other crate of ours. No delivered program links
//! the emulator's GPL-2.0 library. This check reads the manifests as cargo does. It also reads
//! sources where the manifest is not enough: the emulator's, and the roots of the crates without
//! `unsafe`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::args::Args;
use crate::process::list;
use crate::{files, modules, ordered, outcome::Outcome, process, rooms, workspace};

pub const HELP: &str = "\
usage: cargo xtask arrows

Checks the dependencies between the crates against the rules in xtask/src/arrows.rs; that the
emulator takes nothing but the geometry of the silicon from shared-abi (its program the names of
the boards, too); that the pure crates
forbid unsafe code; that neither modules nor files of a crate use each other in circles, and those of
boot-core and coflash-core no others than xtask/src/rooms.rs allows; and that everything is there that
the owner of the product ordered by name (xtask/src/ordered.rs).
";

/// The crates of ours that one of our crates may depend on. Dev- and build-dependencies follow the
/// same rule. A new crate needs a row.
const RULES: &[(&str, &str)] = &[
    ("shared-abi", ""),
    ("canopen", "kit"),
    ("seal", ""),
    ("boot-core", "canopen seal shared-abi kit"),
    ("coboot-app", "canopen shared-abi"),
    // Only on the host: build scripts and tools.
    ("coboot-linker", "shared-abi"),
    ("bsp", "canopen shared-abi"),
    // The package bootloader, by the name of its library.
    ("product", "boot-core bsp coboot-linker seal shared-abi"),
    ("app-template", "canopen coboot-app coboot-linker bsp"),
    ("app-template-v2", "app-template canopen coboot-app coboot-linker bsp"),
    ("test-app", "app-template canopen coboot-app coboot-linker bsp shared-abi"),
    ("vendor-can", ""),
    ("coboot-can", "canopen shared-abi vendor-can"),
    ("coflash-core", "canopen coboot-can coboot-linker seal shared-abi kit"),
    ("coflash-conform", "canopen coboot-can coflash-core shared-abi"),
    ("coflash-agent", "canopen coboot-can coflash-core shared-abi kit"),
    ("coflash-ui", "canopen coboot-can coflash-core shared-abi kit"),
    ("coflash", "canopen coboot-can coflash-agent coflash-conform coflash-core coflash-ui seal shared-abi kit"),
    ("coflash-native", "canopen coboot-can coflash-core shared-abi"),
    ("coboot-node", "boot-core canopen coboot-app coboot-can coflash-agent coflash-conform coflash-core shared-abi kit"),
    // Its command line reads memory maps.
    ("emulator", "coboot-linker shared-abi"),
    (KIT, "boot-core canopen coboot-app coboot-can seal shared-abi"),
    (
        "coboot-tests",
        "app-template attack boot-core bsp canopen coboot-app coboot-can coboot-node coflash-conform coflash-core emulator product seal shared-abi kit",
    ),
    ("attack", "boot-core canopen coflash-core seal shared-abi kit"),
    ("coboot-fuzz", "attack boot-core canopen coboot-can coflash-conform coflash-core coflash-ui seal shared-abi kit"),
    ("coboot-zencan", "bsp canopen coboot-can coboot-tests coflash-core emulator"),
    ("new-board", "shared-abi"),
    ("xtask", "new-board shared-abi kit"),
];

/// What the tests share: in no package, and so a dev-dependency, of crates that have tests with it.
const KIT: &str = "kit";
/// The crates that consist of tests, and may use the kit like any other crate.
const TESTS: [&str; 3] = ["coboot-tests", "coboot-fuzz", "attack"];

/// The crates that need no `unsafe` and forbid it to the compiler.
const PURE: &str =
    "canopen seal boot-core coboot-linker coboot-can coflash-core coflash-conform coflash-agent \
                    coflash-ui coflash coboot-node attack new-board xtask";
/// The attribute that forbids it.
const FORBID: &str = "#![forbid(unsafe_code)]";

/// The crates that may link the GPL-2.0 library.
const MAY_LINK_UNICORN: &[&str] = &["emulator", "coboot-tests"];

/// The crate that must not know our drivers.
const EMULATOR: &str = "emulator";
/// The only module of shared-abi that describes the chips and not our choices.
const GEOMETRY: &str = "geometry";
/// The only part of the emulator that may look up a board by its name: its command line, which
/// models no register.
const COMMAND_LINE: &str = "src/bin/";

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    let metadata = process::metadata()?;
    let packages = packages(&metadata)?;
    let mut broken = broken_arrows(&packages);
    broken.extend(ordered::broken()?);
    if !packages.iter().any(|package| package.name == EMULATOR) {
        return Err(format!("the workspace has no crate \"{EMULATOR}\"."));
    }
    for package in &packages {
        broken.extend(broken_sources(package)?);
    }
    if broken.is_empty() {
        println!("{} crates, and every arrow points where it may.", packages.len());
        return Ok(());
    }
    for line in &broken {
        println!("{line}");
    }
    Err(format!("{} rules of the house are broken; see xtask/src/arrows.rs and ordered.rs.", broken.len()))
}

/// A crate of the workspace.
#[derive(Debug, PartialEq, Eq)]
struct Package {
    /// The crate's name in sources: the name of its library, with dashes, or of the package if
    /// there is no library. (In the registry `canopen` is the package `coboot-canopen`.)
    name: String,
    folder: PathBuf,
    /// Names of all dependencies by their real names, with their kind (`normal`, `dev`, `build`).
    dependencies: Vec<(String, &'static str)>,
}

/// Reads the output of `cargo metadata --no-deps`.
fn packages(metadata: &Value) -> Outcome<Vec<Package>> {
    let has_other = |value: &Value, kinds: &str, not: &str| list(value, kinds).any(|kind| kind != not);
    let is_library = |target: &&Value| {
        has_other(target, "kind", "custom-build") && has_other(target, "crate_types", "bin")
    };
    let mut libraries = BTreeMap::new();
    for package in list(metadata, "packages") {
        let library = list(package, "targets").find(is_library).and_then(|library| library["name"].as_str());
        if let (Some(name), Some(library)) = (package["name"].as_str(), library) {
            libraries.insert(name, library.replace('_', "-"));
        }
    }
    let called = |package: &str| libraries.get(package).map_or(package, String::as_str).to_owned();
    let package = |value: &Value| -> Option<Package> {
        let dependency = |dependency: &Value| {
            let kind = match dependency["kind"].as_str() {
                None => "normal",
                Some("dev") => "dev",
                Some(_) => "build",
            };
            Some((called(dependency["name"].as_str()?), kind))
        };
        Some(Package {
            name: called(value["name"].as_str()?),
            folder: Path::new(value["manifest_path"].as_str()?).parent()?.to_owned(),
            dependencies: list(value, "dependencies").map(dependency).collect::<Option<_>>()?,
        })
    };
    let found: Option<Vec<_>> = list(metadata, "packages").map(package).collect();
    found
        .filter(|packages| !packages.is_empty())
        .ok_or_else(|| "cargo metadata printed something unexpected.".into())
}

/// The dependencies that no rule permits, as messages.
fn broken_arrows(packages: &[Package]) -> Vec<String> {
    let rules: BTreeMap<_, _> = RULES.iter().copied().collect();
    let mut broken = Vec::new();
    for package in packages {
        let name = package.name.as_str();
        let Some(may_use) = rules.get(name) else {
            broken.push(format!("{name}: a crate without a rule; give it a row in xtask/src/arrows.rs"));
            continue;
        };
        for (dependency, kind) in &package.dependencies {
            let dependency = dependency.as_str();
            let ours =
                rules.contains_key(dependency) || packages.iter().any(|package| package.name == dependency);
            // A crate is among its own dev-dependencies in order to test with all its features.
            let itself = dependency == name && *kind == "dev";
            if ours && !itself && !may_use.split(' ').any(|name| name == dependency) {
                broken.push(format!("{name} -> {dependency} ({kind}): not among its arrows ({may_use})"));
            }
            if dependency == KIT && *kind != "dev" && !TESTS.contains(&name) {
                broken.push(format!(
                    "{name} -> {dependency} ({kind}): it is in no package, and for tests alone"
                ));
            }
            if dependency.starts_with("unicorn") && !MAY_LINK_UNICORN.contains(&name) {
                broken.push(format!(
                    "{name} -> {dependency} ({kind}): only {MAY_LINK_UNICORN:?} may link it, it is GPL-2.0"
                ));
            }
            if name == "shared-abi" && *kind == "normal" {
                broken.push(format!("{name} -> {dependency}: shared-abi has no dependencies"));
            }
        }
    }
    broken
}

/// What the sources of a crate break, as messages.
fn broken_sources(package: &Package) -> Outcome<Vec<String>> {
    let (mut broken, mut files) = (Vec::new(), Vec::new());
    for path in files::below(&package.folder, &[])?.iter().filter(|path| files::is(path, "rs")) {
        let (text, shown) = (files::text(path)?, workspace::shown(path));
        let inside = path.strip_prefix(&package.folder).unwrap_or(path).to_string_lossy().replace('\\', "/");
        if package.name == EMULATOR && !inside.starts_with(COMMAND_LINE) {
            broken.extend(foreign_modules(&text).into_iter().map(|used| {
                format!(
                    "{shown}: the emulator uses {used}; of shared_abi it may use `{GEOMETRY}` alone (its knowledge comes \
                     from the reference manual)"
                )
            }));
        }
        let is_root = ["src/lib.rs", "src/main.rs"].contains(&&*inside);
        let is_pure = PURE.split(' ').any(|name| name == package.name);
        if is_root && is_pure && !text.lines().any(|line| line.trim() == FORBID) {
            broken.push(format!("{shown}: {FORBID} is missing"));
        }
        files.extend(inside.strip_prefix("src/").map(|inside| (inside.to_owned(), text)));
    }
    broken.extend(rooms::broken(&package.name, &files));
    Ok(broken)
}

/// What a source names of shared-abi besides its geometry, as paths; the crate alone is a glob or an
/// alias.
fn foreign_modules(source: &str) -> Vec<String> {
    let mut paths = modules::paths(&modules::without_comments(source));
    paths.retain(|path| path[0] == "shared_abi" && path.get(1).is_none_or(|module| module != GEOMETRY));
    paths.iter().map(|path| path.join("::")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A workspace with these dependencies: `from -> to to`, `from dev to`, `from build to`.
    fn workspace_of(arrows: &[&str]) -> Vec<Package> {
        let mut packages: Vec<Package> = Vec::new();
        for arrow in arrows {
            let mut words = arrow.split(' ');
            let (name, kind) = (words.next().unwrap().to_owned(), words.next().unwrap());
            let kind = ["dev", "build"].into_iter().find(|known| *known == kind).unwrap_or("normal");
            let dependencies = words.map(|to| (to.to_owned(), kind)).collect();
            match packages.iter_mut().find(|package| package.name == name) {
                Some(package) => package.dependencies.extend(dependencies),
                None => packages.push(Package { name, folder: PathBuf::new(), dependencies }),
            }
        }
        packages
    }

    /// The kinds of arrows; `cargo xtask arrows` itself sees all that there are.
    #[test]
    fn the_arrows_of_the_house_are_allowed() {
        let house = workspace_of(&[
            "canopen -> heapless",
            "canopen dev canopen kit",
            "boot-core build shared-abi",
            "shared-abi dev proptest",
            "emulator -> shared-abi unicorn-engine",
            "coboot-tests -> emulator kit",
            "coboot-tests dev unicorn-engine",
            "kit -> boot-core",
        ]);
        assert_eq!(broken_arrows(&house), Vec::<String>::new());
    }

    #[test]
    fn each_wall_holds() {
        for wall in [
            "app-template -> boot-core",
            "app-template dev boot-core",
            "coboot-app -> boot-core bsp",
            "coboot-linker -> coboot-app",
            "bsp -> boot-core",
            "canopen -> shared-abi kit",
            "canopen dev boot-core",
            "shared-abi -> canopen crc",
            "emulator -> canopen bsp",
            "emulator dev boot-core kit",
            "product -> canopen",
            "product build coflash",
            "product dev kit",
            "coboot-can -> coflash-core",
            "coflash-core -> coflash-ui",
            "coflash -> emulator unicorn-engine",
            "boot-core dev unicorn-engine-sys",
            "boot-core build kit",
            "coboot-node -> kit",
            "kit -> emulator",
            "xtask -> emulator",
            "newcomer -> crc",
        ] {
            let words: Vec<&str> = wall.split(' ').collect();
            for to in &words[2..] {
                let broken = broken_arrows(&workspace_of(&[&format!("{} {} {to}", words[0], words[1])]));
                assert!(!broken.is_empty(), "{wall}: {to} passed");
                assert!(broken[0].starts_with(words[0]), "{broken:?}");
            }
        }
    }

    #[test]
    fn an_arrow_to_a_crate_without_a_rule_is_broken_too() {
        let house = workspace_of(&["newcomer -> crc", "canopen -> newcomer"]);
        assert_eq!(broken_arrows(&house).len(), 2);
    }

    /// The output format of `cargo metadata --format-version 1 --no-deps`, with a renamed
    /// dependency and all kinds.
    #[test]
    fn metadata_is_read_by_the_real_names() {
        let text = r#"{"packages":[{"name":"coboot-canopen","manifest_path":"/x/canopen/Cargo.toml","targets":[
            {"kind":["custom-build"],"crate_types":["bin"],"name":"build-script-build"},
            {"kind":["lib"],"crate_types":["lib"],"name":"canopen"},
            {"kind":["bin"],"crate_types":["bin"],"name":"tool"}
        ],"dependencies":[
            {"name":"heapless","source":"registry","req":"^0.9","kind":null,"rename":null,"optional":false},
            {"name":"coboot-core","source":null,"req":"*","kind":"dev","rename":"innocent","path":"/x/boot-core"},
            {"name":"crc","source":"registry","req":"^3","kind":"build","rename":null,"target":"cfg(unix)"}
        ]},{"name":"coboot-core","manifest_path":"/x/boot-core/Cargo.toml","targets":[
            {"kind":["lib"],"crate_types":["lib"],"name":"boot_core"}
        ],"dependencies":[]}],"workspace_members":[]}"#;
        let packages = packages(&process::json(text).unwrap()).unwrap();
        assert_eq!(
            packages,
            [
                Package {
                    name: "canopen".into(),
                    folder: "/x/canopen".into(),
                    dependencies: vec![
                        ("heapless".into(), "normal"),
                        ("boot-core".into(), "dev"),
                        ("crc".into(), "build")
                    ],
                },
                Package { name: "boot-core".into(), folder: "/x/boot-core".into(), dependencies: vec![] }
            ]
        );
        assert_eq!(broken_arrows(&packages).len(), 1);
        assert!(super::packages(&process::json("{}").unwrap()).is_err());
        assert!(super::packages(&process::json(r#"{"packages":[{"name":1}]}"#).unwrap()).is_err());
    }

    #[test]
    fn the_emulator_may_use_the_geometry_alone() {
        for (source, foreign) in [
            ("use shared_abi::geometry::{Geometry, Region};", &[][..]),
            ("use shared_abi::geometry;\nlet x = my_shared_abi::layout;", &[]),
            ("// shared_abi::layout\n/// [`shared_abi::layout`]\nuse a; // shared_abi::x", &[]),
            ("use shared_abi::{geometry::{Region, Sector}, geometry};", &[]),
            ("use shared_abi::layout::Layout;", &["shared_abi::layout::Layout"]),
            (
                "use shared_abi::{geometry::{Region, Sector}, handoff,\n  warm_start::{WarmStart}};",
                &["shared_abi::handoff", "shared_abi::warm_start::WarmStart"],
            ),
            ("let y = shared_abi::vectors::check(0);", &["shared_abi::vectors::check"]),
            ("#[cfg(test)]\nmod tests { use shared_abi::layout; }", &["shared_abi::layout"]),
            ("use shared_abi::*;", &["shared_abi"]),
            ("use shared_abi as abi;", &["shared_abi"]),
            ("extern crate shared_abi;", &["shared_abi"]),
        ] {
            assert_eq!(foreign_modules(source), foreign, "{source}");
        }
    }

    #[test]
    fn every_rule_speaks_of_crates_that_have_one() {
        for (name, may_use) in RULES {
            for used in may_use.split_terminator(' ') {
                assert!(RULES.iter().any(|(other, _)| *other == used), "{name} -> {used}");
            }
        }
    }
}
