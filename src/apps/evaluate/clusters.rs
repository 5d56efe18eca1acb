//! Reads and writes `clusters.txt`, the clusters of other choices (method 6): one line per cluster,
//! the key view and its partners, separated by tabs.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use crate::{
    base::{
        error::{Advice, Hint},
        input::{self, FileKind},
    },
    model::{
        cluster::ViewCluster,
        scene::{Scene, ViewIndex},
    },
};

/// An error in a list of view clusters.
#[derive(Debug, thiserror::Error)]
pub enum ClustersError {
    #[error("{}: {source}", path.display())]
    Io {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{}: line {line}: {what}", path.display())]
    Line {
        path: PathBuf,
        line: usize,
        what: String,
    },
}

impl Hint for ClustersError {
    fn hint(&self) -> Option<Advice> {
        Some("give a clusters.txt of this model: a line per cluster, key view and partners separated by tabs".into())
    }
}

/// Reads the clusters of a `clusters.txt`, in the order of its lines.
pub fn read(path: &Path, scene: &Scene) -> Result<Vec<ViewCluster>, ClustersError> {
    let text = input::read_text(path, FileKind::List).map_err(|source| ClustersError::Io {
        path: path.into(),
        source,
    })?;
    let mut clusters = Vec::new();
    let mut keys = BTreeSet::new();
    for (line, content) in text
        .lines()
        .enumerate()
        .filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#'))
    {
        let wrong = |what: String| ClustersError::Line {
            path: path.into(),
            line: line + 1,
            what,
        };
        let find = |name: &str| {
            scene
                .find(name)
                .ok_or_else(|| wrong(format!("no view is called {name}")))
        };
        let views = content
            .split('\t')
            .map(find)
            .collect::<Result<Vec<ViewIndex>, _>>()?;
        if views.iter().collect::<BTreeSet<_>>().len() < views.len() {
            return Err(wrong("a view is in the cluster twice".into()));
        }
        // A view has one depth map, whose partners must be known.
        if !keys.insert(views[0]) {
            return Err(wrong(format!(
                "{} has a cluster already",
                scene.name(views[0])
            )));
        }
        clusters.push(ViewCluster {
            key: views[0],
            partners: views[1..].to_vec(),
        });
    }
    Ok(clusters)
}

/// Returns the text of a `clusters.txt`.
pub fn write<'a>(clusters: impl IntoIterator<Item = &'a ViewCluster>, scene: &Scene) -> String {
    let line = |cluster: &ViewCluster| {
        let names: Vec<&str> = cluster.views().map(|view| scene.name(view)).collect();
        names.join("\t") + "\n"
    };
    clusters.into_iter().map(line).collect()
}
