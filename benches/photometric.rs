//! Measures the cost of comparing pictures (method 7.4) beside that of decoding them.
//!
//!     cargo bench --bench photometric -- PROJECT
//!
//! One thread. Printed per image: the time of a plain decode to colour and of one to grey levels,
//! of sampling and comparing (decoding included), and what is left of it per megapixel without the
//! decode.

use std::{path::Path, time::Instant};

use viewrank::{
    backends,
    config::{CommandLineSettings, ConfidenceSource, Configuration, Files},
};
use viewrank_core::{
    base::{column::Storage, progress::NoWatcher},
    method::{
        confidence::{Agreement, ProgramReach, SampleRoom},
        geometry::Geometry,
    },
};
use viewrank_io::{pictures::PictureFolders, project::Project};
use zune_jpeg::{
    JpegDecoder,
    zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions},
};

type Fallible<T> = Result<T, Box<dyn std::error::Error>>;

fn main() -> Fallible<()> {
    let arguments: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| a != "--bench")
        .collect();
    let project = match &arguments[..] {
        // Run with all other benchmarks.
        [] => return Ok(()),
        [project] => Project::open(Path::new(project), None)?,
        _ => return Err("give PROJECT".into()),
    };
    let files = Files {
        user: None,
        root: None,
        project: Some(project.root.join("viewrank.toml")),
    };
    let mut settings = Configuration::load(
        &files,
        CommandLineSettings::default(),
        backends::canonical_name,
    )?
    .settings;
    settings.confidence.source = ConfidenceSource::Geometric;
    let plan = viewrank::plan(&project, &settings, &NoWatcher)?;
    let stages = &plan.stages;
    let images = project.images.clone().ok_or("the project has no images")?;
    let paths: Vec<_> = stages
        .scene
        .views
        .iter()
        .map(|view| images.join(&view.name))
        .collect();
    let geometry = Geometry {
        scene: &stages.scene,
        surface: &stages.surface,
        visibility: &stages.visibility,
        target: &stages.target,
        image_scale: stages.settings.image_scale(),
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let per_image = |seconds: f64| 1e3 * seconds / paths.len() as f64;
    let [colour, grey] = [ColorSpace::RGB, ColorSpace::Luma].map(|space| decode(&paths, space));
    let ([colour, megapixels], [grey, _]) = (colour?, grey?);
    let room = SampleRoom {
        keep: Storage::Memory,
        views_at_once: 16,
    };
    let start = Instant::now();
    let partners = |view| stages.candidates.candidates_of(view);
    let pictures = PictureFolders::new(&project);
    let agreement = pool.install(|| {
        Agreement::new(
            &geometry,
            &pictures,
            partners,
            &ProgramReach::EVERYTHING,
            room,
            &NoWatcher,
        )
    })?;
    let compared = start.elapsed().as_secs_f64();
    let views = paths.len() as f64;
    println!(
        "{views} images of {:.1} Mpx, {:.1} partners each",
        megapixels / views,
        agreement.partners.len() as f64 / views
    );
    println!(
        "plain decode to colour     {:8.1} ms an image",
        per_image(colour)
    );
    println!(
        "plain decode to grey       {:8.1} ms an image",
        per_image(grey)
    );
    println!(
        "decode, sample and compare {:8.1} ms an image, {:.2} of a plain decode",
        per_image(compared),
        compared / colour
    );
    println!(
        "without the decode         {:8.1} ms an image",
        per_image(compared - grey)
    );
    Ok(())
}

/// Seconds and megapixels of all images, decoded one after the other.
fn decode(paths: &[std::path::PathBuf], space: ColorSpace) -> Fallible<[f64; 2]> {
    let (mut seconds, mut megapixels) = (0.0, 0.0);
    for path in paths {
        let bytes = std::fs::read(path)?;
        let options = DecoderOptions::default().jpeg_set_out_colorspace(space);
        let start = Instant::now();
        let mut decoder = JpegDecoder::new_with_options(ZCursor::new(&bytes), options);
        std::hint::black_box(
            decoder
                .decode()
                .map_err(|error| format!("{}: {error:?}", path.display()))?,
        );
        seconds += start.elapsed().as_secs_f64();
        let (width, height) = decoder.dimensions().unwrap_or((0, 0));
        megapixels += (width * height) as f64 / 1e6;
    }
    Ok([seconds, megapixels])
}
