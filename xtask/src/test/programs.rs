//! The test programs that cargo builds, and the tests in them.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use serde_json::Value;

use crate::{outcome::Outcome, process, workspace};

/// After this time the tests of a module count as hanging, on the wall clock.
pub const PATIENCE: Duration = Duration::from_secs(900);

/// A test program: a crate's own tests, or its tests from outside.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Program {
    /// The package, and for the tests from outside their target: `coboot-core`, `device`.
    pub name: String,
    /// The package.
    pub package: String,
    /// The folder of the package, in which cargo runs its tests.
    folder: PathBuf,
    /// The executable file.
    file: PathBuf,
}

/// Builds the test programs of packages; `arguments` select them for cargo.
pub fn build(arguments: &[String]) -> Outcome<Vec<Program>> {
    let mut cargo = process::cargo("test --no-run --message-format=json-render-diagnostics");
    cargo.args(arguments).current_dir(workspace::root()).stderr(std::process::Stdio::inherit());
    // On its standard output are messages for programs; the errors it has shown.
    let messages = process::output(&mut cargo)
        .map_err(|_| "the test programs do not build; what cargo printed above says why.".to_owned())?;
    Ok(messages.lines().filter_map(of_message).collect())
}

/// The test program of a message of cargo, if it is about one.
fn of_message(line: &str) -> Option<Program> {
    let message: Value = serde_json::from_str(line).ok()?;
    let is_test = message["profile"]["test"].as_bool()?;
    let file = PathBuf::from(message["executable"].as_str()?);
    let folder = Path::new(message["manifest_path"].as_str()?).parent()?.to_owned();
    // `path+file:///coboot/core/seal#coboot-seal@0.1.0`, or without the name where it is the folder's.
    let id = message["package_id"].as_str()?.rsplit('#').next()?;
    let package = match id.split_once('@') {
        Some((name, _)) => name.to_owned(),
        None => folder.file_name()?.to_str()?.to_owned(),
    };
    let target = &message["target"];
    let from_outside = target["kind"].as_array()?.iter().any(|kind| kind == "test");
    let name = match target["name"].as_str()? {
        name if from_outside && package == "coboot-tests" => name.to_owned(),
        name if from_outside => format!("{package}/{name}"),
        _ => package.clone(),
    };
    is_test.then_some(Program { name, package, folder, file })
}

impl Program {
    /// The command that runs the program as cargo does, for [`PATIENCE`] at most.
    pub fn command(&self) -> Command {
        let mut command = process::within(PATIENCE, &self.file);
        command.current_dir(&self.folder).env("CARGO_MANIFEST_DIR", &self.folder);
        command
    }

    /// A program for the tests of this job.
    #[cfg(test)]
    pub fn of_a_test(name: &str, file: PathBuf) -> Self {
        Self { name: name.into(), package: name.into(), folder: ".".into(), file }
    }

    /// The tests: those that run, and the number of the others (`#[ignore]`).
    pub fn tests(&self) -> Outcome<(Vec<String>, usize)> {
        let list = |more: &[&str]| -> Outcome<Vec<String>> {
            let said = process::output(self.command().args(["--list", "--format=terse"]).args(more))?;
            Ok(said.lines().filter_map(|line| line.strip_suffix(": test")).map(str::to_owned).collect())
        };
        let ignored = list(&["--ignored"])?;
        let mut tests = list(&[])?;
        tests.retain(|test| !ignored.contains(test));
        Ok((tests, ignored.len()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files;

    /// Messages in cargo's form ("External tools" in its book), shortened.
    #[test]
    fn a_test_program_is_named_by_its_package_or_its_target() {
        let message = |package: &str, kind: &str, target: &str, test: bool| {
            format!(
                r#"{{"reason":"compiler-artifact","package_id":"path+file:///x/{package}","manifest_path":"/x/Cargo.toml","target":{{"kind":["{kind}"],"name":"{target}"}},"profile":{{"test":{test}}},"executable":"/x/t-1"}}"#
            )
        };
        let name = |line: String| of_message(&line).map(|program| program.name);
        assert_eq!(
            name(message("core/seal#coboot-seal@0.1.0", "lib", "seal", true)).as_deref(),
            Some("coboot-seal")
        );
        assert_eq!(
            name(message("sim/node#coboot-node@0.1.0", "test", "it", true)).as_deref(),
            Some("coboot-node/it")
        );
        assert_eq!(
            name(message("tests#coboot-tests@0.1.0", "test", "device", true)).as_deref(),
            Some("device")
        );
        assert_eq!(name(message("coflash#0.1.0", "bin", "coflash", false)), None);
        assert_eq!(of_message("{\"reason\":\"build-finished\"}"), None);
        assert_eq!(of_message("no JSON"), None);
    }

    /// `test = false` saves a link, and would let a test rest in silence.
    #[test]
    fn what_cargo_builds_no_tests_of_has_none() {
        let metadata = process::metadata().unwrap();
        let targets =
            process::list(&metadata, "packages").flat_map(|package| process::list(package, "targets"));
        let kinds = ["lib", "bin", "cdylib"];
        let without =
            |target: &&Value| kinds.iter().any(|kind| target["kind"][0] == **kind) && target["test"] == false;
        for target in targets.filter(without) {
            let folder = Path::new(target["src_path"].as_str().unwrap()).parent().unwrap();
            for file in files::below(folder, &[]).unwrap() {
                let is_test = |line: &str| line.trim() == "#[test]";
                assert!(!files::text(&file).unwrap().lines().any(is_test), "{}", file.display());
            }
        }
    }
}
