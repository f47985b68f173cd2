//! `cargo xtask arrows`: checks which crate depends on which.
//!
//! The crates are separated by a few rules. The emulator does not use our drivers, so that a
//! mistake in one does not cancel out in the other. The application does not use `boot-core`, so
//! that it can be replaced. The wire code uses no other crate of ours. No delivered program links
//! the emulator's GPL-2.0 library. This check reads the manifests as cargo does. It also reads
//! sources where the manifest is not enough: the emulator's, and the roots of the crates without
//! `unsafe`.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use crate::args::Args;
use crate::{ordered, process, rooms, workspace, Outcome};
use serde_json::Value;

pub const HELP: &str = "\
usage: cargo xtask arrows

Checks the dependencies between the crates against the rules in xtask/src/arrows.rs; that the
emulator takes nothing but the geometry of the silicon from shared-abi (its program the names of
the boards, too); that the pure crates
forbid unsafe code; that neither modules nor files of a crate use each other in circles, and those of
boot-core and coflash no others than xtask/src/rooms.rs allows; and that everything is there that
the owner of the product ordered by name (xtask/src/ordered.rs).
";

/// The crates of ours that one of our crates may depend on. Dev- and build-dependencies follow the
/// same rule.
struct Rule {
    name: &'static str,
    may_use: &'static [&'static str],
}

/// The permitted dependencies. A new crate needs a row.
const RULES: &[Rule] = &[
    Rule { name: "shared-abi", may_use: &[] },
    Rule { name: "canopen", may_use: &[KIT] },
    Rule { name: "seal", may_use: &[] },
    Rule { name: "boot-core", may_use: &["canopen", "seal", "shared-abi", KIT] },
    Rule { name: "coboot-app", may_use: &["canopen", "shared-abi"] },
    // Only on the host: build scripts and tools.
    Rule { name: "coboot-linker", may_use: &["shared-abi"] },
    Rule { name: "bsp", may_use: &["canopen", "shared-abi"] },
    Rule { name: "bootloader", may_use: &["boot-core", "bsp", "coboot-linker", "seal", "shared-abi"] },
    Rule { name: "app-template", may_use: &["canopen", "coboot-app", "coboot-linker", "bsp"] },
    Rule {
        name: "app-template-v2",
        may_use: &["app-template", "canopen", "coboot-app", "coboot-linker", "bsp"],
    },
    Rule {
        name: "test-app",
        may_use: &["app-template", "canopen", "coboot-app", "coboot-linker", "bsp", "shared-abi"],
    },
    Rule { name: "vendor-can", may_use: &[] },
    Rule { name: "coflash", may_use: &["canopen", "coboot-linker", "seal", "shared-abi", "vendor-can", KIT] },
    Rule { name: "coflash-native", may_use: &["canopen", "coflash", "shared-abi"] },
    Rule {
        name: "coboot-node",
        may_use: &["boot-core", "canopen", "coboot-app", "coflash", "shared-abi", KIT],
    },
    Rule { name: "emulator", may_use: &["shared-abi"] },
    Rule { name: KIT, may_use: &["boot-core", "canopen", "coboot-app", "shared-abi"] },
    Rule {
        name: "coboot-tests",
        may_use: &[
            "app-template",
            "boot-core",
            "bsp",
            "canopen",
            "coboot-app",
            "coboot-node",
            "coflash",
            "emulator",
            "seal",
            "shared-abi",
            KIT,
        ],
    },
    Rule { name: "xtask", may_use: &["shared-abi", KIT] },
];

/// What the tests share: in no package, and so a dev-dependency, of crates that have tests with it.
const KIT: &str = "kit";
/// The crates that consist of tests and checks, and may use the kit like any other crate.
const MAY_CONTAIN_KIT: &[&str] = &["coboot-tests", "xtask"];

/// The crates that need no `unsafe` and forbid it to the compiler.
const PURE: &[&str] =
    &["canopen", "seal", "boot-core", "coboot-linker", "coflash", "coboot-node", "kit", "xtask"];
/// The attribute that forbids it.
const FORBID: &str = "#![forbid(unsafe_code)]";

/// The crates that may link the GPL-2.0 library.
const MAY_LINK_UNICORN: &[&str] = &["emulator", "coboot-tests"];

/// The only module of shared-abi that describes the chips and not our choices.
const GEOMETRY: &str = "geometry";
/// The only part of the emulator that may look up a board by its name: its command line, which
/// models no register.
const COMMAND_LINE: &str = "src/bin";

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    let metadata = process::output(process::cargo("metadata").args(["--no-deps", "--format-version", "1"]))?;
    let metadata = process::json(&metadata)?;
    let packages = packages(&metadata)?;
    let mut broken = broken_arrows(&packages);
    broken.extend(ordered::broken(&metadata)?);
    let Some(emulator) = packages.iter().find(|package| package.name == "emulator") else {
        return Err("the workspace has no crate \"emulator\".".into());
    };
    let command_line = emulator.folder.join(COMMAND_LINE);
    for path in sources(&emulator.folder)?.into_iter().filter(|path| !path.starts_with(&command_line)) {
        for (line, module) in foreign_modules(&read(&path)?) {
            broken.push(format!(
                "{}:{line}: the emulator uses shared_abi::{module}; of shared-abi it may use `{GEOMETRY}` alone \
                 (its knowledge comes from the reference manual)",
                workspace::shown(&path)
            ));
        }
    }
    for package in packages.iter().filter(|package| PURE.contains(&package.name.as_str())) {
        let roots = ["src/lib.rs", "src/main.rs"].map(|root| package.folder.join(root));
        for root in roots.iter().filter(|root| root.exists()) {
            if !read(root)?.lines().any(|line| line.trim() == FORBID) {
                broken.push(format!("{}: {FORBID} is missing", workspace::shown(root)));
            }
        }
    }
    for package in &packages {
        let root = package.folder.join("src");
        let mut files = Vec::new();
        for path in sources(&package.folder)? {
            if let Ok(inside) = path.strip_prefix(&root) {
                files.push((inside.to_string_lossy().replace('\\', "/"), read(&path)?));
            }
        }
        broken.extend(rooms::broken(&package.name, &files));
    }
    if broken.is_empty() {
        println!("{} crates, and every arrow points where it may.", packages.len());
        return Ok(());
    }
    for line in &broken {
        println!("{line}");
    }
    Err(format!(
        "{} rules of the house are broken; they stand in xtask/src/arrows.rs and ordered.rs.",
        broken.len()
    ))
}

fn read(path: &Path) -> Outcome<String> {
    fs::read_to_string(path).map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(path)))
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
    let mut libraries = BTreeMap::new();
    for package in metadata["packages"].as_array().into_iter().flatten() {
        let is_library = |target: &&Value| {
            target["kind"].as_array().into_iter().flatten().any(|kind| kind.as_str() != Some("custom-build"))
                && target["crate_types"]
                    .as_array()
                    .into_iter()
                    .flatten()
                    .any(|kind| kind.as_str() != Some("bin"))
        };
        let library = package["targets"].as_array().into_iter().flatten().find(is_library);
        if let (Some(name), Some(library)) = (package["name"].as_str(), library) {
            let library = library["name"].as_str().unwrap_or_default().replace('_', "-");
            libraries.insert(name.to_owned(), library);
        }
    }
    let called = |package: &str| libraries.get(package).map_or(package, String::as_str).to_owned();
    let package = |value: &Value| -> Option<Package> {
        let mut dependencies = Vec::new();
        for dependency in value["dependencies"].as_array().into_iter().flatten() {
            let kind = match dependency["kind"].as_str() {
                None => "normal",
                Some("dev") => "dev",
                Some(_) => "build",
            };
            dependencies.push((called(dependency["name"].as_str()?), kind));
        }
        let manifest = Path::new(value["manifest_path"].as_str()?);
        Some(Package {
            name: called(value["name"].as_str()?),
            folder: manifest.parent()?.to_owned(),
            dependencies,
        })
    };
    let found: Option<Vec<_>> = metadata["packages"].as_array().into_iter().flatten().map(package).collect();
    found
        .filter(|packages| !packages.is_empty())
        .ok_or_else(|| "cargo metadata printed something unexpected.".into())
}

/// The dependencies that no rule permits, as messages.
fn broken_arrows(packages: &[Package]) -> Vec<String> {
    let rules: BTreeMap<_, _> = RULES.iter().map(|rule| (rule.name, rule.may_use)).collect();
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
            if ours && !itself && !may_use.contains(&dependency) {
                broken.push(format!("{name} -> {dependency} ({kind}): not among its arrows ({may_use:?})"));
            }
            if dependency == KIT && *kind != "dev" && !MAY_CONTAIN_KIT.contains(&name) {
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

/// All Rust sources below a crate's folder.
fn sources(folder: &Path) -> Outcome<Vec<PathBuf>> {
    let mut sources = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        let entries = fs::read_dir(&folder)
            .map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(&folder)))?;
        for path in entries.flatten().map(|entry| entry.path()) {
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                sources.push(path);
            }
        }
    }
    sources.sort();
    Ok(sources)
}

/// Uses of shared-abi other than `shared_abi::geometry`, with their line numbers. Each foreign
/// member of a group (`use shared_abi::{…}`) counts; so does an alias of the whole crate.
fn foreign_modules(source: &str) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    // Comments are removed (in place, to keep the line numbers): they may name any module.
    let code: String = source
        .split_inclusive('\n')
        .map(|line| match line.find("//") {
            Some(at) => format!("{}\n", &line[..at]),
            None => line.to_owned(),
        })
        .collect();
    for (at, krate) in code.match_indices("shared_abi") {
        let part_of_a_word = |letter: char| letter.is_alphanumeric() || letter == '_';
        let rest = &code[at + krate.len()..];
        if code[..at].ends_with(part_of_a_word) || rest.starts_with(part_of_a_word) {
            continue;
        }
        let line = code[..at].matches('\n').count() + 1;
        let Some(path) = rest.trim_start().strip_prefix("::") else {
            found.push((line, "(the crate under another name)".to_owned()));
            continue;
        };
        let path = path.trim_start();
        match path.strip_prefix('{') {
            None => found.extend(foreign(path).map(|module| (line, module))),
            Some(group) => found.extend(members(group).filter_map(foreign).map(|module| (line, module))),
        }
    }
    found
}

/// The first word of a path, unless it is the geometry.
fn foreign(path: &str) -> Option<String> {
    let end = path.find(|letter: char| !letter.is_alphanumeric() && letter != '_').unwrap_or(path.len());
    let module = if end == 0 { path.get(..1).unwrap_or("") } else { &path[..end] };
    (module != GEOMETRY).then(|| module.to_owned())
}

/// The members of a group, without its opening brace; inner braces belong to a member.
fn members(group: &str) -> impl Iterator<Item = &str> {
    let mut depth = 1;
    let mut borders = vec![0];
    for (at, letter) in group.char_indices() {
        match letter {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 1 => borders.push(at + 1),
            _ => {}
        }
        if depth == 0 {
            borders.push(at + 1);
            break;
        }
    }
    let ranges: Vec<_> = borders.windows(2).map(|pair| (pair[0], pair[1] - 1)).collect();
    ranges.into_iter().map(|(from, to)| group[from..to].trim()).filter(|member| !member.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A workspace with these dependencies: `from -> to`, `from dev to`, `from build to`.
    fn workspace_of(arrows: &[&str]) -> Vec<Package> {
        let mut packages: Vec<Package> = Vec::new();
        for arrow in arrows {
            let words: Vec<_> = arrow.split(' ').collect();
            let kind = match words[1] {
                "dev" => "dev",
                "build" => "build",
                _ => "normal",
            };
            let dependency = (words[2].to_owned(), kind);
            match packages.iter_mut().find(|package| package.name == words[0]) {
                Some(package) => package.dependencies.push(dependency),
                None => packages.push(Package {
                    name: words[0].to_owned(),
                    folder: PathBuf::new(),
                    dependencies: vec![dependency],
                }),
            }
        }
        packages
    }

    #[test]
    fn the_arrows_of_the_house_are_allowed() {
        let house = workspace_of(&[
            "canopen -> heapless",
            "boot-core -> canopen",
            "boot-core build shared-abi",
            "bootloader -> boot-core",
            "bootloader -> bsp",
            "app-template -> canopen",
            "app-template -> bsp",
            "app-template -> coboot-app",
            "app-template build coboot-linker",
            "coboot-app -> canopen",
            "bsp -> canopen",
            "coflash -> canopen",
            "emulator -> shared-abi",
            "emulator -> unicorn-engine",
            "coboot-tests -> emulator",
            "coboot-tests dev unicorn-engine",
            "xtask -> shared-abi",
            "shared-abi dev proptest",
            "canopen dev canopen",
            "canopen dev kit",
            "boot-core dev kit",
            "coboot-node dev kit",
            "coboot-tests -> kit",
            "kit -> boot-core",
        ]);
        assert_eq!(broken_arrows(&house), Vec::<String>::new());
    }

    #[test]
    fn each_wall_holds() {
        for arrow in [
            "app-template -> boot-core",
            "app-template dev boot-core",
            "coboot-app -> boot-core",
            "coboot-app -> bsp",
            "coboot-linker -> coboot-app",
            "bsp -> boot-core",
            "canopen -> shared-abi",
            "canopen dev boot-core",
            "shared-abi -> canopen",
            "shared-abi -> crc",
            "emulator -> canopen",
            "emulator -> bsp",
            "emulator dev boot-core",
            "bootloader -> canopen",
            "bootloader build coflash",
            "coflash -> emulator",
            "coflash -> unicorn-engine",
            "boot-core dev unicorn-engine-sys",
            "coboot-tests -> bootloader",
            "xtask -> emulator",
            "canopen -> kit",
            "boot-core build kit",
            "coboot-node -> kit",
            "bootloader dev kit",
            "emulator dev kit",
            "kit -> emulator",
            "newcomer -> crc",
        ] {
            let broken = broken_arrows(&workspace_of(&[arrow]));
            assert!(!broken.is_empty(), "{arrow} passed");
            assert!(broken[0].starts_with(arrow.split(' ').next().unwrap()), "{broken:?}");
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
        let modules = |source| foreign_modules(source);
        assert_eq!(modules("use shared_abi::geometry::{Geometry, Region};\n"), []);
        assert_eq!(modules("use shared_abi::geometry;\nlet x = my_shared_abi::layout;"), []);
        assert_eq!(modules("// shared_abi::layout\n/// [`shared_abi::layout`]\nuse a; // shared_abi::x"), []);
        assert_eq!(modules("use shared_abi::{geometry::{Region, Sector}, geometry};"), []);
        assert_eq!(modules("\nuse shared_abi::layout::Layout;"), [(2, "layout".into())]);
        assert_eq!(
            modules("use shared_abi::{geometry::{Region, Sector}, handoff,\n  warm_start::{WarmStart}};"),
            [(1, "handoff".into()), (1, "warm_start".into())]
        );
        assert_eq!(modules("let y = shared_abi::vectors::check(0);"), [(1, "vectors".into())]);
        assert_eq!(modules("use shared_abi::*;"), [(1, "*".into())]);
        assert_eq!(modules("use shared_abi as abi;").len(), 1);
        assert_eq!(modules("extern crate shared_abi;").len(), 1);
        assert_eq!(modules("use shared_abi::{").len(), 0);
    }

    #[test]
    fn every_rule_speaks_of_crates_that_have_one() {
        for rule in RULES {
            for used in rule.may_use {
                assert!(RULES.iter().any(|other| other.name == *used), "{} -> {used}", rule.name);
            }
        }
    }
}
