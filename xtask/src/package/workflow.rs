//! The workflows that a public forge runs: each must be readable, and run existing jobs.

use kit::pages::Shown;
use yaml_rust2::{Yaml, YamlLoader};

use crate::{docs, files};

/// The faults of a workflow; empty if it is right.
fn faults(text: &str) -> Vec<String> {
    let mut faults = Vec::new();
    match YamlLoader::load_from_str(text).as_deref() {
        Ok([workflow]) => add(workflow, &mut faults),
        other => faults.push(format!("this is no workflow: {other:?}")),
    }
    faults
}

/// Adds the faults of a part of a workflow: an action without its version, a job that is not there.
fn add(part: &Yaml, faults: &mut Vec<String>) {
    part.as_vec().into_iter().flatten().for_each(|part| add(part, faults));
    for (name, value) in part.as_hash().into_iter().flatten() {
        match (name.as_str(), value.as_str()) {
            (Some("uses"), Some(action)) if !action.contains('@') => {
                faults.push(format!("{action}: which version of it?"));
            }
            (Some("run"), Some(lines)) => faults.extend(lines.lines().filter_map(command)),
            _ => add(value, faults),
        }
    }
}

/// The fault of a line for the shell, if it runs a job of ours that is known before the run.
fn command(line: &str) -> Option<String> {
    let words: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
    let is_job = line.starts_with("cargo xtask") && !words.get(2)?.starts_with("${{");
    let fault = docs::check(&Shown { place: line.to_owned(), words, inline: false }).filter(|_| is_job)?;
    Some(format!("{line}: {fault}"))
}

#[test]
fn the_workflows_run_what_is_there_and_a_broken_one_is_told() {
    let read = |name| files::ours(std::path::Path::new(".github/workflows").join(name)).unwrap();
    for name in ["ci.yml", "nightly.yml", "release.yml", "site.yml"] {
        assert_eq!(faults(&read(name)), Vec::<String>::new(), "{name}");
    }
    for (right, wrong, fault) in [
        ("run: cargo xtask package", "run: cargo xtask pakage", "there is no job pakage"),
        ("--check --yes", "--chekc --yes", "has no --chekc"),
        ("checkout@v4", "checkout", "which version"),
        ("\njobs:", "\n\tjobs: [", "no workflow"),
    ] {
        let workflow = read("release.yml");
        let broken = workflow.replacen(right, wrong, 1);
        assert_ne!(broken, workflow, "{right}");
        let faults = faults(&broken);
        assert!(faults.iter().any(|told| told.contains(fault)), "{wrong}: {faults:?}");
    }
}
