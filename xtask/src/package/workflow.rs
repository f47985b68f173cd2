//! The workflow that a public forge runs for a release: it must be readable, and run existing jobs.

use kit::pages::Shown;
use yaml_rust2::{Yaml, YamlLoader};

use crate::{docs, files};

/// The faults of a workflow; empty if it is right.
fn faults(text: &str) -> Vec<String> {
    let workflow = match YamlLoader::load_from_str(text).as_deref() {
        Ok([workflow]) => workflow.clone(),
        other => return vec![format!("this is no workflow: {other:?}")],
    };
    let mut faults = Vec::new();
    if workflow["on"] == Yaml::BadValue {
        faults.push("nothing starts it".into());
    }
    if !text.contains("cargo xtask package") {
        faults.push("nothing calls cargo xtask package".into());
    }
    for (name, job) in workflow["jobs"].as_hash().into_iter().flatten() {
        let name = name.as_str().unwrap_or_default();
        if job["runs-on"].as_str().is_none() {
            faults.push(format!("{name}: runs on nothing"));
        }
        for step in job["steps"].as_vec().into_iter().flatten() {
            match (step["uses"].as_str(), step["run"].as_str()) {
                (Some(action), None) if action.contains('@') => {}
                (Some(action), None) => faults.push(format!("{action}: which version of it?")),
                (None, Some(lines)) => faults.extend(lines.lines().filter_map(|line| command(name, line))),
                _ => faults.push(format!("{name}: a step that neither uses nor runs something: {step:?}")),
            }
        }
    }
    faults
}

/// The fault of a line for the shell. The forge's own tool is not checked.
fn command(place: &str, line: &str) -> Option<String> {
    let words: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
    if words.is_empty() || line.trim_start().starts_with("gh release ") {
        return None;
    }
    let fault = docs::check(&Shown { place: place.to_owned(), words, inline: false })?;
    Some(format!("{line}: {fault}"))
}

#[test]
fn the_release_workflow_runs_what_is_there_and_a_broken_one_is_told() {
    let workflow = files::ours(".github/workflows/release.yml").unwrap();
    assert_eq!(faults(&workflow), Vec::<String>::new());
    for (right, wrong, fault) in [
        ("run: cargo xtask package", "run: cargo xtask pakage", "there is no job pakage"),
        ("--check --yes", "--chekc --yes", "has no --chekc"),
        ("run: cargo xtask package", "run: make package", "nobody knows"),
        ("checkout@v4", "checkout", "which version"),
        ("    runs-on: ubuntu-22.04\n", "", "runs on nothing"),
        ("        run: cargo", "        ran: cargo", "neither uses nor runs"),
        ("\njobs:", "\n\tjobs: [", "no workflow"),
        ("\non:\n", "\nno:\n", "nothing starts it"),
    ] {
        let broken = workflow.replacen(right, wrong, 1);
        assert_ne!(broken, workflow, "{right}");
        let faults = faults(&broken);
        assert!(faults.iter().any(|told| told.contains(fault)), "{wrong}: {faults:?}");
    }
}
