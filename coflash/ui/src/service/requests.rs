//! The requests of the page of a station, and their answers.

use std::collections::BTreeSet;
use std::sync::Arc;

use axum::extract::{Query, State};
use axum::http::{header, StatusCode};
use axum::response::{IntoResponse as _, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use canopen::NodeId;
use coflash_core::file::inspect::Date;
use coflash_core::machine::version;
use serde::Deserialize;
use serde_json::json;

use super::report::Entered;
use super::setup::Origin;
use super::sheet::{html, POLICY};
use super::station::{change, Stage, Station};
use super::words::TABLE;
use super::work::{is_due, Search, Update};
use crate::adapters;
use crate::http::{bad, done, download, idle, json_response, node_id, password_of};
use crate::http::{Answer, Body, Open, Page, Refused, Site, CSS, HTML, SCRIPT};
use crate::shared::Order;

const FILES: [(&str, &str, &str); 11] = [
    ("", HTML, concat!(include_str!("../page/head.html"), include_str!("page/service.html"))),
    ("colours.css", CSS, include_str!("../page/colours.css")),
    ("service.css", CSS, include_str!("page/service.css")),
    ("service.js", SCRIPT, include_str!("page/service.js")),
    ("sheet.js", SCRIPT, include_str!("page/sheet.js")),
    ("words.json", "application/json", TABLE),
    ("icon.svg", "image/svg+xml", include_str!("../page/icon.svg")),
    ("dom.js", SCRIPT, include_str!("../page/dom.js")),
    ("events.js", SCRIPT, include_str!("../page/events.js")),
    ("stream.js", SCRIPT, include_str!("../page/stream.js")),
    ("kept.js", SCRIPT, include_str!("../page/kept.js")),
];

/// The page of this station.
pub(super) fn page(station: &Arc<Station>) -> Page {
    let routes = Router::new()
        .route("/station", get(describe))
        .route("/open", post(open))
        .route("/search", post(search))
        .route("/update", post(update))
        .route("/save", post(save))
        .route("/report", get(report))
        .route("/sheet", get(sheet))
        .layer(Extension(station.clone()));
    let view = {
        let station = station.clone();
        Arc::new(move |state: &crate::state::State| station.view(state))
    };
    Page { files: &FILES, view, routes }
}

/// What does not change while the station runs, and the adapters.
async fn describe(State(site): State<Site>, Extension(station): Extension<Arc<Station>>) -> Response {
    let tool = site.shared.tool.clone();
    let found = tokio::task::spawn_blocking(move || adapters::list(&site.kinds)).await.unwrap_or_default();
    let service = &station.service;
    let manifest = service.package.manifest();
    let signature = match (&service.origin, service.package.signers()) {
        (Origin::Trusted(_), _) => Some("signature-good"),
        (Origin::Package, []) => Some("signature-none"),
        (Origin::Package, _) => Some("signature-unknown"),
        // Nobody can sign one.
        (Origin::Job, _) => None,
    };
    let programs = service.package.programs().map(|(entry, program)| {
        json!({ "name": entry.name, "version": version(program), "nodes": entry.nodes, "count": entry.count })
    });
    let value = json!({
        "adapters": found,
        "last": service.last_bus(),
        "package": {
            "kind": service.origin.key(),
            "file": service.file,
            "name": manifest.name,
            "release": manifest.release,
            "date": service.package.date().map(|date| Date(date).to_string()),
            "signature": signature,
            "programs": programs.collect::<Vec<_>>(),
        },
        "folder": service.report_dir().display().to_string(),
        "version": tool,
    });
    json_response(StatusCode::OK, &value)
}

/// Another adapter leads to another bus: its devices are not those of the plan.
async fn open(
    State(site): State<Site>,
    Extension(station): Extension<Arc<Station>>,
    Body(Open { url }): Body<Open>,
) -> Answer {
    idle(&site)?;
    site.shared.order(Order::Open(url.trim().to_owned()))?;
    change(&site.shared, &station, |own| {
        own.message = None;
        own.stage = Stage::Waiting;
    });
    done()
}

async fn search(State(site): State<Site>, Extension(station): Extension<Arc<Station>>) -> Answer {
    site.shared.begin(Search(station))?;
    done()
}

/// A plan that the user has confirmed.
#[derive(Deserialize)]
struct Confirmed {
    /// The number of the plan that the page shows.
    plan: u64,
    /// The devices that get their programs.
    nodes: Vec<u8>,
    /// The password of locked devices; empty for none. It is not a part of what is entered for the report.
    #[serde(default)]
    password: String,
    #[serde(flatten)]
    entered: Entered,
}

async fn update(
    State(site): State<Site>,
    Extension(station): Extension<Arc<Station>>,
    Body(confirmed): Body<Confirmed>,
) -> Answer {
    let Confirmed { plan: number, nodes, password, entered } = confirmed;
    idle(&site)?;
    if !entered.is_text() {
        return Err(bad(
            "a field of the report has more than 100 characters, or control characters",
            "enter it again",
        ));
    }
    let unlock = password_of(&password)?;
    let Some(plan) = station.plan(number) else {
        let (words, advice) = ("there is a newer plan, or none", "look at the devices, and confirm again");
        return Err(Refused::new(StatusCode::CONFLICT, words, advice));
    };
    let nodes = nodes.into_iter().map(node_id).collect::<Result<BTreeSet<NodeId>, Refused>>()?;
    let due: BTreeSet<NodeId> =
        plan.devices.iter().filter(|device| is_due(device)).map(|it| it.node).collect();
    if let Some(node) = nodes.difference(&due).next() {
        return Err(bad(format!("the plan writes nothing to node {node}"), "choose devices of the plan"));
    }
    let is_needed = plan.updates() > 0;
    if plan.devices.is_empty() || (nodes.is_empty() && is_needed) {
        return Err(bad("no device is chosen", "choose one of the plan"));
    }
    site.shared.begin(Update { station, number, plan, nodes, unlock, entered })?;
    done()
}

/// Tries again to save the reports.
async fn save(State(site): State<Site>, Extension(station): Extension<Arc<Station>>) -> Answer {
    let saving = station.clone();
    let _ = tokio::task::spawn_blocking(move || saving.save()).await;
    change(&site.shared, &station, |_| {});
    done()
}

#[derive(Deserialize)]
struct Wanted {
    number: usize,
}

/// A report that could not be saved, for the browser to save.
async fn report(
    Extension(station): Extension<Arc<Station>>,
    Query(Wanted { number }): Query<Wanted>,
) -> Answer {
    let Some(report) = station.unsaved(number) else {
        let (words, advice) = ("there is no such report", "it may have been saved meanwhile");
        return Err(Refused::new(StatusCode::NOT_FOUND, words, advice));
    };
    Ok(download(&format!("{}.html", report.name()), HTML, html(&report)))
}

/// The report of the machine, for the browser to print.
async fn sheet(Extension(station): Extension<Arc<Station>>) -> Answer {
    let Some(report) = station.sheet() else {
        let (words, advice) = ("there was no update yet", "update the devices first");
        return Err(Refused::new(StatusCode::NOT_FOUND, words, advice));
    };
    let page = html(&report).replacen("</head>", "<script src=\"sheet.js\" defer></script>\n</head>", 1);
    let head = [(header::CONTENT_TYPE, HTML), (header::CONTENT_SECURITY_POLICY, POLICY)];
    Ok((head, page).into_response())
}
