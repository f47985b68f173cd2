//! The workflow that a public forge runs for a release: it must be readable, and run existing jobs.

use std::fs;

use yaml_rust2::{Yaml, YamlLoader};

use crate::{docs, workspace};
use kit::pages::Shown;

/// The faults of a workflow; empty if it is right.
fn faults(text: &str) -> Vec<String> {
    let documents = match YamlLoader::load_from_str(text) {
        Ok(documents) => documents,
        Err(error) => return vec![error.to_string()],
    };
    let [workflow] = documents.as_slice() else { return vec!["there is more than one document".into()] };
    let mut faults = Vec::new();
    let Some(jobs) = workflow["jobs"].as_hash() else { return vec!["there are no jobs".into()] };
    let mut calls = 0;
    for (name, job) in jobs {
        let name = name.as_str().unwrap_or_default();
        if job["runs-on"].as_str().is_none() {
            faults.push(format!("{name}: runs on nothing"));
        }
        for step in job["steps"].as_vec().map(Vec::as_slice).unwrap_or_default() {
            match (step["uses"].as_str(), step["run"].as_str()) {
                (Some(action), None) => {
                    if !action.contains('@') {
                        faults.push(format!("{action}: which version of it?"));
                    }
                }
                (None, Some(lines)) => {
                    calls += lines.matches("cargo xtask package").count();
                    faults.extend(lines.lines().filter_map(|line| command(name, line)));
                }
                _ => faults.push(format!("{name}: a step that neither uses nor runs something: {step:?}")),
            }
        }
    }
    if calls == 0 {
        faults.push("nothing calls cargo xtask package".into());
    }
    if workflow["on"] == Yaml::BadValue {
        faults.push("nothing starts it".into());
    }
    faults
}

/// The fault of a line for the shell. The forge's own tool is not checked.
fn command(place: &str, line: &str) -> Option<String> {
    let words: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
    if words.is_empty() || words.starts_with(&["gh".to_owned(), "release".to_owned()]) {
        return None;
    }
    docs::check(&Shown { place: place.to_owned(), words, inline: false })
        .map(|fault| format!("{line}: {fault}"))
}

fn release() -> String {
    let file = workspace::root().join(".github/workflows/release.yml");
    fs::read_to_string(file).expect("the workflow is there")
}

#[test]
fn the_release_workflow_runs_what_is_there() {
    assert_eq!(faults(&release()), Vec::<String>::new());
}

#[test]
fn a_broken_workflow_is_told() {
    let workflow = release();
    for (right, wrong, fault) in [
        ("run: cargo xtask package", "run: cargo xtask pakage", "there is no job pakage"),
        ("--check --yes", "--chekc --yes", "has no --chekc"),
        ("run: cargo xtask package", "run: make package", "nobody knows"),
        ("checkout@v4", "checkout", "which version"),
        ("    runs-on: ubuntu-22.04\n", "", "runs on nothing"),
        ("        run: cargo", "        ran: cargo", "neither uses nor runs"),
        ("\njobs:", "\n\tjobs: [", ""),
        ("\non:\n", "\nno:\n", "nothing starts it"),
    ] {
        let broken = workflow.replacen(right, wrong, 1);
        assert_ne!(broken, workflow, "{right}");
        let faults = faults(&broken);
        assert!(faults.iter().any(|told| told.contains(fault)), "{wrong}: {faults:?}");
    }
}
