//! RealityScan (RealityCapture), from the vendor's pages; not run. An XMP side file next to an
//! image can exclude it from meshing; nothing else is configurable.

use std::collections::HashMap;

use super::{
    Backend, BackendError, Capabilities, ExaminedProject, Export, ExportOptions, ExportRecord,
    Honours, LastRun, Selection, Trap, images::ANY_PROGRAM, selection::is_below,
};
use crate::{
    base::{
        input::{self, FileKind},
        paths::stem,
    },
    io::project::Project,
    model::scene::ViewIndex,
};

pub static BACKEND: Backend = Backend {
    name: "realityscan",
    aliases: &["realitycapture"],
    program: "RealityScan",
    last_run: LastRun::Never("documentation"),
    capabilities: Capabilities {
        partners: Honours::No,
        key_subset: Honours::Partly,
        order: Honours::No,
        fusion: "internal",
        notes: "an image is either used for meshing or not: key views and partners together",
    },
    planning: ANY_PROGRAM,
    takes_distorted: true,
    traps,
    export,
    reads_raw: true,
    ..Backend::DEFAULT
};

fn traps(examined: &ExaminedProject) -> Vec<Trap> {
    let same = examined.same_names(
        "realityscan-xmp-same-stem",
        "the same side file (.xmp)",
        |name| stem(path_of(examined.project, name)).to_owned(),
    );
    same.into_iter().chain(poses_beside(examined)).collect()
}

fn export(selection: &Selection, options: &ExportOptions) -> Result<Export, BackendError> {
    selection.refuse_unusable_images(BACKEND.name)?;
    let (scene, used) = (selection.scene, selection.views());
    let path = |view: ViewIndex| path_of(selection.project, scene.name(view));
    let mut files = options.file_set(&BACKEND, selection);
    let mut by_stem: HashMap<&str, &str> = HashMap::new();
    let (mut side_files, mut images) = (String::new(), String::new());
    for view in scene.view_indices() {
        let name = path(view);
        let stem = stem(name);
        if let Some(other) = by_stem.insert(stem, name) {
            let why = format!("its side file would be that of {other} too");
            return Err(BackendError::name(BACKEND.name, name, why));
        }
        let is_used = used.binary_search(&view).is_ok();
        // Also for images that are not used: without a side file they would take part in meshing.
        files.add_text(format!("xmp/{stem}.xmp"), side_file(is_used));
        side_files += &format!("{stem}.xmp\n");
        if is_used {
            images += &format!("{name}\n");
        }
    }
    files.add_text("xmp.txt", side_files);
    files.add_text("images.txt", images);
    let mut record = ExportRecord::new(&BACKEND, selection, |v| {
        format!("xmp/{}.xmp", stem(path(v)))
    });
    record.made_for = "RealityScan, RealityCapture (from the vendor's pages; not run)".into();
    record.way =
        "side files that switch meshing, to lie beside the images before these are added".into();
    files.add_script(
        "switch.py",
        include_str!("../../integrations/realityscan/switch.py"),
    );
    record.commands = vec![format!(
        "python3 -I switch.py {}",
        selection.images_in_commands(&files.root)
    )];
    record.not_honoured.extend([
        "matching partners".into(),
        "depth maps of key views only: partners take part in meshing as well".into(),
        "the rank order".into(),
    ]);
    record.note_own_scale(selection);
    record.warnings.extend([
        "side files beside the images that hold poses are left as they are, and named: add the two switches to them"
            .into(),
    ]);
    record.other_maps = used.len() - selection.clusters.len();
    record.fusion = "internal".into();
    Ok(Export::new(files, record))
}

/// Warns of existing side files with poses next to the images.
fn poses_beside(examined: &ExaminedProject) -> Option<Trap> {
    let images = examined.project.images.as_ref()?;
    let holds_pose = |view: &ViewIndex| {
        let image = images.path_of(examined.scene.name(*view));
        let path = images.join(format!("{}.xmp", stem(image)));
        input::read_text(&path, FileKind::List)
            .is_ok_and(|text| text.contains("xcr:PosePrior") || text.contains("xcr:Position"))
    };
    let views: Vec<ViewIndex> = examined.scene.view_indices().filter(holds_pose).collect();
    (!views.is_empty()).then(|| Trap {
        name: "realityscan-existing-xmp-poses",
        what: "side files (.xmp) beside the images hold poses, which files of the same name would replace".into(),
        cure: "add xcr:InMeshing and xcr:InTexturing to those files by hand instead of copying ours".into(),
        views,
    })
}

/// Path of an image's file in the folder of images, beside which its side file lies.
fn path_of<'a>(project: &'a Project, name: &'a str) -> &'a str {
    let images = project.images.as_ref();
    let path = images.map(|images| images.path_of(name));
    // Side files cannot be written beside one outside of the folder.
    path.filter(|path| is_below(path)).unwrap_or(name)
}

/// Returns a side file with only the switches: RealityScan would interpret further attributes as a
/// pose.
fn side_file(used: bool) -> String {
    let switch = u8::from(used);
    format!(
        "<x:xmpmeta xmlns:x=\"adobe:ns:meta/\">\n  <rdf:RDF xmlns:rdf=\"http://www.w3.org/1999/02/22-rdf-syntax-ns#\">\n    \
         <rdf:Description xmlns:xcr=\"http://www.capturingreality.com/ns/xcr/1.1#\" xcr:InMeshing=\"{switch}\" xcr:InTexturing=\"{switch}\"/>\n  \
         </rdf:RDF>\n</x:xmpmeta>\n"
    )
}
