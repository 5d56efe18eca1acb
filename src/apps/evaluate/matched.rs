//! The partners that a backend really matched with each key view: from `report.json` of
//! `integrations/sgm` and the records of its single tasks in `rows/`, or from the ids in OpenMVS's
//! maps.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use serde::Deserialize;
use walkdir::WalkDir;

use crate::{
    base::{
        bounded,
        error::{Advice, Hint},
        input::{self, FileKind},
    },
    io::{
        depthmaps::{self, DepthMapFile, DepthMapFormat},
        json::place_and_fault,
    },
    model::{
        cluster::ViewCluster,
        scene::{Scene, ViewIndex},
    },
};

/// A key view's partners as reported by the backend.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReportedPartners {
    pub tried: Vec<ViewIndex>,
    pub matched: Vec<ViewIndex>,
}

/// Reports in a folder of depth maps, by key view; empty without reports.
pub type Report = BTreeMap<ViewIndex, ReportedPartners>;

#[derive(Deserialize)]
struct File {
    #[serde(deserialize_with = "bounded::list::<_, _, 1_000_000>")]
    clusters: Vec<Row>,
}

#[derive(Deserialize)]
struct Row {
    key: String,
    partners: Vec<Partner>,
}

#[derive(Deserialize)]
struct Partner {
    name: String,
    matched: bool,
}

/// A report that can't be read.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {what}")]
pub struct MatcherReportError {
    pub path: PathBuf,
    pub what: String,
}

impl Hint for MatcherReportError {
    fn hint(&self) -> Option<Advice> {
        Some(
            "run the matcher again, or take the report away: all partners then count as matched"
                .into(),
        )
    }
}

/// Reads the reports in a folder of depth maps. Names that are not in the scene are left out. Rows
/// of single tasks replace those of `report.json`.
pub fn read_report(folder: &Path, scene: &Scene) -> Result<Report, MatcherReportError> {
    let mut report = read_file(folder.join("report.json"), scene)?;
    // Sorted: where two rows are of one key view, the same one counts on every disk.
    let rows = WalkDir::new(folder.join("rows"))
        .sort_by_file_name()
        .into_iter()
        .filter_map(Result::ok);
    for entry in rows.filter(|entry| {
        entry
            .path()
            .extension()
            .is_some_and(|extension| extension == "json")
    }) {
        report.extend(read_file(entry.into_path(), scene)?);
    }
    Ok(report)
}

fn read_file(path: PathBuf, scene: &Scene) -> Result<Report, MatcherReportError> {
    let bytes = match input::read(&path, FileKind::Plan) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Report::new()),
        Err(error) => {
            return Err(MatcherReportError {
                path,
                what: error.to_string(),
            });
        }
    };
    let file: File = serde_json::from_slice(&bytes).map_err(|error| MatcherReportError {
        path: path.clone(),
        what: place_and_fault(&error, &bytes),
    })?;
    let entry = |row: &Row| {
        let partners = |wanted: fn(&&Partner) -> bool| {
            row.partners
                .iter()
                .filter(wanted)
                .filter_map(|p| scene.find(&p.name))
                .collect()
        };
        let reported = ReportedPartners {
            tried: partners(|_| true),
            matched: partners(|p| p.matched),
        };
        Some((scene.find(&row.key)?, reported))
    };
    Ok(file.clusters.iter().filter_map(entry).collect())
}

/// Returns the cluster with the partners that were really matched: from the report, else from the
/// ids in its depth map (OpenMVS uses the model's image ids, key view first), else all partners.
pub fn really_matched(
    cluster: &ViewCluster,
    report: &Report,
    ids: &[u32],
    scene: &Scene,
) -> ViewCluster {
    let partners = match (report.get(&cluster.key), ids) {
        (Some(reported), _) => reported.matched.clone(),
        (None, [_, partners @ ..]) => scene
            .view_indices()
            .filter(|&v| partners.contains(&scene.view(v).image_id))
            .collect(),
        (None, []) => cluster.partners.clone(),
    };
    ViewCluster {
        key: cluster.key,
        partners,
    }
}

/// Returns the partners tried for each depth map: from the report, else from the map's ids, else
/// from the clusters of the plan; maps with no known partners are left out.
pub fn tried(
    folder: &Path,
    maps: &[DepthMapFile],
    scene: &Scene,
    planned: &[ViewCluster],
) -> Result<Vec<ViewCluster>, MatcherReportError> {
    let report = read_report(folder, scene)?;
    let of = |map: &DepthMapFile| -> Option<ViewCluster> {
        if let Some(reported) = report.get(&map.view) {
            return Some(ViewCluster {
                key: map.view,
                partners: reported.tried.clone(),
            });
        }
        let ids = match map.format {
            DepthMapFormat::OpenMvs => depthmaps::ids_of(&map.path).unwrap_or_default(),
            _ => Vec::new(),
        };
        let own = planned.iter().find(|c| c.key == map.view).cloned();
        let cluster = own.unwrap_or(ViewCluster {
            key: map.view,
            partners: Vec::new(),
        });
        Some(really_matched(&cluster, &report, &ids, scene))
            .filter(|cluster| !cluster.partners.is_empty())
    };
    Ok(maps.iter().filter_map(of).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::project::Project;

    #[test]
    fn the_report_decides_then_the_ids_then_the_plan() {
        let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/valley");
        let scene = Project::open(&fixture, None)
            .and_then(|p| p.read_scene())
            .unwrap();
        let view = |name: &str| scene.find(name).unwrap();
        let (a, b, c) = (
            view("grid_028.jpg"),
            view("grid_029.jpg"),
            view("grid_030.jpg"),
        );
        let cluster = ViewCluster {
            key: a,
            partners: vec![b, c],
        };
        let folder = tempfile::tempdir().unwrap();
        assert!(read_report(folder.path(), &scene).unwrap().is_empty());
        let text = r#"{"version": 1, "clusters": [{"key": "grid_028.jpg", "width": 1, "partners": [
            {"name": "grid_029.jpg", "matched": false, "refused": "why"}, {"name": "grid_030.jpg", "matched": true}]},
            {"key": "elsewhere.jpg", "partners": []}]}"#;
        std::fs::write(folder.path().join("report.json"), text).unwrap();
        let report = read_report(folder.path(), &scene).unwrap();
        assert_eq!(report.len(), 1);
        assert_eq!(report[&a].tried, [b, c]);
        let ids = [scene.view(a).image_id, scene.view(b).image_id, 999_999];
        assert_eq!(
            really_matched(&cluster, &report, &ids, &scene).partners,
            [c]
        );
        assert_eq!(
            really_matched(&cluster, &Report::new(), &ids, &scene).partners,
            [b]
        );
        assert_eq!(
            really_matched(&cluster, &Report::new(), &[], &scene).partners,
            [b, c]
        );
        let row = r#"{"clusters": [{"key": "grid_028.jpg", "partners": [{"name": "grid_029.jpg", "matched": true}]}]}"#;
        std::fs::create_dir(folder.path().join("rows")).unwrap();
        std::fs::write(folder.path().join("rows/grid_028.jpg.json"), row).unwrap();
        let newer = read_report(folder.path(), &scene).unwrap();
        assert_eq!((newer.len(), &newer[&a].matched), (1, &vec![b]));
        std::fs::write(folder.path().join("report.json"), "{").unwrap();
        assert!(
            read_report(folder.path(), &scene)
                .unwrap_err()
                .to_string()
                .contains("report.json")
        );
    }
}
