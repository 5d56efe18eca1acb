//! What semi-global matchers share: numbers measured with the one of this repository (`sgm`), which
//! plans for SURE take too (`sure.rs`), and the lists of pairs (method 6).

use super::{BackendError, Selection};
use crate::{
    method::confidence::{PairConfidence, Photometric},
    model::{
        cluster::{MapScale, RankedCluster},
        scene::ViewIndex,
    },
};

/// Best of the settings tried, by real curves.
pub(super) const CONFIDENCE: PairConfidence = PairConfidence {
    min_matches: 2,
    p0: 0.9,
    cosine_power: 0.0,
    scale_octaves: Some(2.0),
    full_angle_deg: None,
};

/// By depth maps of seven scenes (method 7.4): semi-global matching also bridges what the pictures
/// do not agree on.
pub(super) const PHOTOMETRIC: Photometric = Photometric {
    agree: 0.95,
    differ: 0.19,
    full_agreement: 0.9,
};

/// `clusters.txt`, `pairs.txt` and `baseImages.txt` (method 6), for other programs, and `sizes.txt`
/// if key views are planned at half the size.
pub fn pair_files(
    backend: &'static str,
    selection: &Selection,
) -> Result<Vec<(&'static str, String)>, BackendError> {
    let lists = lists_of_pairs(selection, |view| {
        checked_name(backend, selection.scene.name(view))
    })?;
    Ok(lists
        .into_iter()
        .chain(sizes(selection).map(|text| ("sizes.txt", text)))
        .collect())
}

/// Returns `sizes.txt`: the key views whose size differs from the others', each with the ratio of
/// the two; `None` if all have one size.
fn sizes(selection: &Selection) -> Option<String> {
    let smaller = selection
        .clusters
        .iter()
        .filter(|cluster| cluster.scale != MapScale::Full);
    let line =
        |c: &RankedCluster| format!("{}\t{}\n", selection.scene.name(c.key), c.scale.factor());
    let text: String = smaller.map(line).collect();
    (!text.is_empty()).then_some(text)
}

/// Returns the three lists, with the names that `name` gives the views.
pub(super) fn lists_of_pairs<'a>(
    selection: &Selection,
    name: impl Fn(ViewIndex) -> Result<&'a str, BackendError>,
) -> Result<[(&'static str, String); 3], BackendError> {
    let (mut clusters, mut pairs, mut keys) = (String::new(), String::new(), String::new());
    for cluster in selection.clusters {
        let key = name(cluster.key)?;
        clusters += key;
        for &partner in &cluster.partners {
            let partner = name(partner)?;
            clusters += &format!("\t{partner}");
            pairs += &format!("{key}\t{partner}\n");
        }
        clusters.push('\n');
        keys += &format!("{key}\n");
    }
    Ok([
        ("clusters.txt", clusters),
        ("pairs.txt", pairs),
        ("baseImages.txt", keys),
    ])
}

/// Refuses a name that cannot be written to a tab-separated file with `#` comments.
pub(super) fn checked_name<'a>(
    backend: &'static str,
    name: &'a str,
) -> Result<&'a str, BackendError> {
    let why = if name.contains(['\t', '\n', '\r']) {
        "a tab or line break separates entries in the pair files"
    } else if name.starts_with('#') {
        "a line that begins with # is a comment in the pair files"
    } else {
        return Ok(name);
    };
    Err(BackendError::name(backend, name, why))
}
