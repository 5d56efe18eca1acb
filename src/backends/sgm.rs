//! The reference matcher of this repository, `integrations/sgm`: semi-global matching of rectified pairs.

use super::{
    Backend, BackendError, Capabilities, Export, ExportOptions, ExportRecord, Honours, PlanningNumbers, Selection, sure,
};
use crate::output::FileSet;

pub struct Sgm;

impl Backend for Sgm {
    fn name(&self) -> &'static str {
        "sgm"
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities {
            partners: Honours::Yes,
            key_subset: Honours::Yes,
            order: Honours::Yes,
            fusion: "each depth map is checked against its own pairs; sgm.py run --colmap writes maps for COLMAP's stereo_fusion",
            notes: "pairs that it cannot rectify are skipped and noted in the depth map's file",
        }
    }

    fn planning(&self) -> PlanningNumbers {
        sure::RECTIFYING
    }

    fn export(&self, selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
        let mut record = ExportRecord::new(self, selection, |v| selection.scene.name(v).into());
        record.made_for = "integrations/sgm".into();
        record.way = "pair files".into();
        record.commands = vec!["see integrations/sgm/README.md".into()];
        record.fusion = "none needed".into();
        let root = options.out.clone().unwrap_or_else(|| selection.project.output_folder().join("sgm"));
        let mut files = FileSet::new(root, "sgm");
        for (name, text) in sure::pair_files(self.name(), selection)? {
            files.add_text(name, text);
        }
        files.add_text("export.json", record.to_json());
        Ok(Export { files, record })
    }
}
