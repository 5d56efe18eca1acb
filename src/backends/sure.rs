//! SURE (nFrames): `backends.md` 12. Closed; the files follow the vendor's public pages and three public writers of `.ori`.

use super::{
    Backend, BackendError, Capabilities, Export, ExportOptions, ExportRecord, Gate, Honours, PlanningNumbers, Selection,
};
use crate::{
    confidence::PairConfidence,
    output::FileSet,
    project::{Project, ProjectKind},
};

pub struct Sure;

/// The numbers of a matcher of rectified pairs (method 7.1 and 7.2).
const RECTIFYING: PlanningNumbers = PlanningNumbers {
    // Scale ratio 1.7.
    gate: Gate {
        min_shared_points: 1,
        min_angle_deg: 1.0,
        max_angle_deg: 60.0,
        max_scale_octaves: 0.7655,
        epipole_inside: false,
    },
    confidence: PairConfidence {
        min_matches: 2,
        p0: 0.8,
        cosine_power: 1.0,
        scale_octaves: Some(0.7),
        full_angle_deg: None,
    },
    support: 1,
    source: "measured with integrations/sgm on valley against exact depth (method 7.1, 7.2); support 1: a depth map is \
             checked against its own pairs",
};

impl Backend for Sure {
    fn name(&self) -> &'static str {
        "sure"
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities {
            partners: Honours::Partly,
            key_subset: Honours::Yes,
            order: Honours::Partly,
            fusion: "built in; each depth map is checked against its own pairs",
            notes: "no public file names pairs: exact partners need one project per cluster",
        }
    }

    fn planning(&self) -> PlanningNumbers {
        RECTIFYING
    }

    fn serves(&self, project: &Project) -> bool {
        project.kind == ProjectKind::Sure
    }

    fn export(&self, selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
        let mut record = ExportRecord::new(self, selection, |v| selection.scene.name(v).into());
        record.made_for = "SURE".into();
        record.way = "pair files".into();
        let root = options.out.clone().unwrap_or_else(|| selection.project.output_folder().join("sure"));
        let mut files = FileSet::new(root, "sure");
        for (name, text) in pair_files(self.name(), selection)? {
            files.add_text(name, text);
        }
        files.add_text("export.json", record.to_json());
        Ok(Export { files, record })
    }
}

/// `clusters.txt`, `pairs.txt` and `baseImages.txt` (method 6), for whoever reads them.
pub fn pair_files(backend: &'static str, selection: &Selection) -> Result<[(&'static str, String); 3], BackendError> {
    let (mut clusters, mut pairs, mut keys) = (String::new(), String::new(), String::new());
    for cluster in selection.clusters {
        let key = checked_name(backend, selection.scene.name(cluster.key))?;
        clusters += key;
        for &partner in &cluster.partners {
            let partner = checked_name(backend, selection.scene.name(partner))?;
            clusters += &format!("\t{partner}");
            pairs += &format!("{key}\t{partner}\n");
        }
        clusters.push('\n');
        keys += &format!("{key}\n");
    }
    Ok([("clusters.txt", clusters), ("pairs.txt", pairs), ("baseImages.txt", keys)])
}

/// A name that survives in a file of lines with tabs between and `#` comments.
fn checked_name<'a>(backend: &'static str, name: &'a str) -> Result<&'a str, BackendError> {
    let why = if name.contains(['\t', '\n', '\r']) {
        "a tab or line break separates entries in the pair files"
    } else if name.starts_with('#') {
        "a line that begins with # is a comment in the pair files"
    } else {
        return Ok(name);
    };
    Err(BackendError::Name { backend, name: name.into(), why: why.into() })
}
