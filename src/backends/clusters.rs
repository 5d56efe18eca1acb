//! `run.sh` of programs that are called once per view cluster: `integrations/run_clusters.sh` is
//! its head. Names and contents of the marks of finished depth maps.

use super::{Backend, Selection, strangers};
use crate::{
    base::shell::quoted,
    model::cluster::{MapScale, RankedCluster},
};

const HEAD: &str = include_str!("../../integrations/run_clusters.sh");

/// A script under construction.
pub struct ClusterScript(String);

impl ClusterScript {
    /// `results`: names of the results of the plan, which end with a hash of what they are made
    /// from ([`recipe`]); `preparation`: lines of sh that follow the head.
    pub fn new(results: &[String], preparation: &str) -> Self {
        let head = strangers::with_refusal(HEAD);
        Self(format!(
            // Names of results are made of hashes, ids, `_` and `-`, so the quotes are safe.
            "{head}results='{}'\n{preparation}",
            results.join(" ")
        ))
    }

    /// Adds a cluster: its commands, each run if the previous one succeeds, unless the sh condition
    /// `is_there` holds.
    pub fn cluster(&mut self, name: &str, is_there: &str, commands: &[String]) {
        let commands = commands.join(" &&\n    ");
        self.0 += &format!(
            "{is_there} || {{\n    {commands}\n}} || fail {}\n",
            quoted(name)
        );
    }

    /// Returns the script, with the commands that fuse the results, each run if the previous one
    /// succeeds.
    pub fn finish(mut self, joining: &[String]) -> String {
        if !joining.is_empty() {
            self.0 += &format!(
                "{{\n    {}\n}} || fail 'the fusion'\n",
                joining.join(" &&\n    ")
            );
        }
        self.0 + "exit \"$failed\"\n"
    }
}

/// Returns `run.sh` of a program whose tasks viewrank runs, too, which goes on from its maps:
/// `integrations/run_maps.sh` is its head. `steps`: the functions `compute` and `join` of the
/// program. `maps`: the key view's name, the content of the mark, the depth map, and the words for
/// `compute`. `joining`: lines of sh that join the maps.
pub fn map_script<'a>(
    steps: &str,
    maps: impl Iterator<Item = (&'a str, &'a str, String, String)>,
    joining: &str,
) -> String {
    // Nothing needs quotes: marks are hashes; paths and options are fixed words and numbers.
    let line = |(key, id, map, words)| format!("map {} {id} {map} {words}\n", task_marker(key));
    let maps: String = maps.map(line).collect();
    strangers::with_refusal(include_str!("../../integrations/run_maps.sh"))
        .replacen("@STEPS@\n", steps, 1)
        .replacen("@MAPS@\n", &maps, 1)
        .replacen("@JOINING@\n", joining, 1)
}

/// Returns the name of a key view as the name of a file, the mark of its finished depth map.
pub fn task_marker(key: &str) -> String {
    hash([key])
}

/// Returns 16 hexadecimal digits of BLAKE3 over the texts.
pub fn hash<'a>(texts: impl IntoIterator<Item = &'a str>) -> String {
    let mut hasher = blake3::Hasher::new();
    for text in texts {
        hasher
            // With its length: the texts "ab", "c" must differ from "a", "bc".
            .update(&(text.len() as u64).to_le_bytes())
            .update(text.as_bytes());
    }
    // The scripts compare the first 16 bytes of a mark.
    hasher.finalize().to_hex()[..16].into()
}

/// Returns the content of the mark, what the depth map is made from, and that of a map of full
/// size, which is as good as one of half the size.
pub fn task_ids(backend: &Backend, selection: &Selection, cluster: &RankedCluster) -> [String; 2] {
    let id = |half: &str| {
        let options = format!("{} {}{half}", backend.name, selection.image_scale);
        recipe(selection, cluster, &options)
    };
    match cluster.scale {
        MapScale::Full => [id(""), id("")],
        MapScale::Half => [id(" half"), id("")],
    }
}

/// Returns the cache key of a depth map: a hash of views, cameras and poses of key view and
/// partners, and of the program's `options`.
pub fn recipe(selection: &Selection, cluster: &RankedCluster, options: &str) -> String {
    let mut text = options.to_owned();
    for view in cluster.views() {
        let (camera, pose) = (
            selection.scene.camera_of(view),
            &selection.scene.view(view).cam_from_world,
        );
        let numbers = [
            camera.params(),
            pose.rotation.matrix().as_slice(),
            pose.translation.as_slice(),
        ]
        .concat();
        text += &format!(
            // Each f64 is written so that it reads back exactly: any change of the pose changes the
            // hash.
            "\n{} {} {} {numbers:?}",
            selection.scene.name(view),
            camera.width,
            camera.height
        );
    }
    blake3::hash(text.as_bytes()).to_hex()[..16].into()
}
