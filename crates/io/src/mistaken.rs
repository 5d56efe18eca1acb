//! Files that are not what their names say: pointers in the place of large files, pages of web
//! servers, archives, text in another encoding.

use std::path::Path;

use crate::{
    formats::{Fault, Problem},
    input::{self, FileKind},
};

/// A file of another kind than its name says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mistaken {
    /// What it is.
    pub what: &'static str,
    /// What to do.
    pub cure: &'static str,
}

/// Bytes that tell.
const START: u64 = 512;

const UNPACK: &str = "unpack it";
const HEIC: &str = "a HEIC image, which MVS programs do not read";
const AVIF: &str = "an AVIF image, which MVS programs do not read";
// The poses and pixels of a model refer to the images as they were.
const AS_JPEG: &str = "convert the images to JPEG, without turning or scaling them";
const AS_UTF8: &str = "save it again as UTF-8";
/// First bytes, what they are, and what to do.
const KINDS: [(&[u8], &str, &str); 12] = [
    (
        b"version https://git-lfs.github.com/spec/",
        "a Git LFS pointer, not the file itself",
        "fetch the file: git lfs pull",
    ),
    (
        b"/annex/objects/",
        "a git-annex pointer, not the file itself",
        "fetch the file: git annex get",
    ),
    (b"\xff\xfe", "text in UTF-16", AS_UTF8),
    (b"\xfe\xff", "text in UTF-16", AS_UTF8),
    (b"PK\x03\x04", "a ZIP archive", UNPACK),
    (b"\x1f\x8b\x08", "a gzip archive", UNPACK),
    (b"BZh", "a bzip2 archive", UNPACK),
    (b"\xfd7zXZ\0", "an xz archive", UNPACK),
    (b"\x28\xb5\x2f\xfd", "a Zstandard archive", UNPACK),
    (
        b"GIF8",
        "a GIF image, which MVS programs do not read",
        AS_JPEG,
    ),
    (b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive", UNPACK),
    (b"Rar!\x1a\x07", "a RAR archive", UNPACK),
];
/// First bytes of a web page, in lower case.
const PAGES: [&[u8]; 2] = [b"<!doctype html", b"<html"];

/// What a file is, by its first bytes, if its reader does not know them. Numbers of a binary model
/// may look like any of these, so only a file that could not be read is judged by them.
pub fn by_start(start: &[u8]) -> Option<Mistaken> {
    let text = start.trim_ascii_start();
    if PAGES.iter().any(|page| {
        text.get(..page.len())
            .is_some_and(|head| head.eq_ignore_ascii_case(page))
    }) {
        return Some(Mistaken {
            what: "a web page, not the file itself",
            cure: "download the file again, from the address of the file itself",
        });
    }
    let known = KINDS.iter().find(|(head, ..)| start.starts_with(head));
    let known = known.map(|&(_, what, cure)| Mistaken { what, cure });
    known.or_else(|| picture_of_phones(start))
}

/// A pointer in the place of a large file; `None` of the file itself.
pub fn pointer(path: &Path) -> Option<Mistaken> {
    // The descriptions of both kinds have the word, and no others.
    of_file(path).filter(|mistaken| mistaken.what.contains("pointer"))
}

/// A picture in the container of videos (ISO 23008-12), whose brand says how it is compressed.
fn picture_of_phones(start: &[u8]) -> Option<Mistaken> {
    let brand = start.get(8..12).filter(|_| start[4..8] == *b"ftyp")?;
    let what = match brand {
        b"avif" | b"avis" => AVIF,
        b"heic" | b"heix" | b"heim" | b"heis" | b"hevc" | b"hevx" | b"mif1" | b"msf1" => HEIC,
        _ => return None,
    };
    let cure = AS_JPEG;
    Some(Mistaken { what, cure })
}

/// What to do about a file that [`by_start`] says to be this.
pub(crate) fn cure_of(what: &str) -> Option<&'static str> {
    let page = by_start(PAGES[0]);
    let kinds = KINDS.iter().map(|&(_, what, cure)| Mistaken { what, cure });
    let pictures = [HEIC, AVIF].map(|what| Mistaken {
        what,
        cure: AS_JPEG,
    });
    let mut all = kinds.chain(page).chain(pictures);
    all.find(|kind| kind.what == what).map(|kind| kind.cure)
}

/// Text in a file whose name says that it is binary; `None` if it isn't.
pub fn text_as_binary(path: &Path) -> Option<Mistaken> {
    let start = input::read_start(path, FileKind::Sparse, START).ok()?;
    let is_text = |byte: &u8| matches!(byte, b' '..=b'~' | b'\n' | b'\r' | b'\t' | 0x80..);
    let is_binary = path.extension().is_some_and(|extension| extension == "bin");
    (is_binary && !start.is_empty() && start.iter().all(is_text)).then_some(Mistaken {
        what: "text, in a file with the name of a binary one",
        cure: "name the files of a text model cameras.txt, images.txt and points3D.txt",
    })
}

/// JSON of another kind in a `transforms.json`, by the fault of reading it.
pub fn json_without_frames(path: &Path, fault: &Fault) -> Option<&'static str> {
    let Problem::Content(what) = &fault.problem else {
        return None;
    };
    // `json::fault` writes these words.
    if !what.contains("\"frames\" is missing") {
        return None;
    }
    let start = input::read_start(path, FileKind::Sparse, START).ok()?;
    let start = String::from_utf8_lossy(&start);
    let is_geojson = ["\"FeatureCollection\"", "\"Feature\"", "\"coordinates\""];
    Some(if is_geojson.iter().any(|word| start.contains(word)) {
        "GeoJSON, not the cameras of nerfstudio"
    } else {
        "JSON of another kind, without the frames of nerfstudio"
    })
}

/// What the file at this path is; `None` if that cannot be said.
pub fn of_file(path: &Path) -> Option<Mistaken> {
    by_start(&input::read_start(path, FileKind::Sparse, START).ok()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_named_for_what_they_are() {
        let what = |bytes: &[u8]| by_start(bytes).map(|mistaken| mistaken.what);
        let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n";
        assert!(what(pointer).unwrap().contains("Git LFS"));
        assert!(what(b"\n<!DOCTYPE HTML><p>").unwrap().contains("web page"));
        assert!(what(b"\xff\xfe#\0 \0").unwrap().contains("UTF-16"));
        assert!(what(b"PK\x03\x04\x14\0").unwrap().contains("ZIP"));
        for known in [
            &b"\xff\xd8\xff\xe0"[..],
            b"\x89PNG",
            b"NVM_V3",
            b"# Camera list",
            b"<",
        ] {
            assert_eq!(what(known), None);
        }
    }
}
