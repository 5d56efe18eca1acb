//! Nothing usable ends with an error, and files are named for what they are.

use super::*;

const POINTER: &str = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 4478379\n";

#[test]
fn images_that_cannot_be_read_are_no_images() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    for n in 0..9 {
        folder.write(&format!("images/view_{n}.png"), POINTER);
    }
    let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 1);
    assert!(stderr.contains("Git LFS"), "{stderr}");
    assert!(
        !stdout.contains("run.py") && stdout.contains("git lfs pull"),
        "{stdout}"
    );
    let (code, ..) = said(&viewrank(&["run", folder.path().to_str().unwrap()]));
    assert_ne!(code, 0);
}

#[test]
fn files_of_a_model_are_named_for_what_they_are() {
    let model = ColmapModel::from_scene(&scene());
    let folder = Folder::new();
    let error = |name: &str, bytes: &[u8]| {
        folder.colmap("sparse/0", &model).write(name, bytes);
        folder.open().read_scene().unwrap_err().to_string()
    };
    assert!(error("sparse/0/points3D.bin", POINTER.as_bytes()).contains("Git LFS"));
    assert!(error("sparse/0/images.bin", b"<!DOCTYPE html><html>").contains("web page"));
    let other = Folder::new();
    other.write("scene.nvm", b"PK\x03\x04 and so on");
    let error = Project::open(other.path(), None).unwrap_err();
    assert!(error.to_string().contains("ZIP"), "{error}");
    let none = Folder::new();
    none.write("cameras.xml", POINTER);
    let (code, _, stderr) = none.plan(&[]);
    assert!(code == 1 && stderr.contains("git lfs pull"), "{stderr}");
}

#[test]
fn a_byte_order_mark_is_no_part_of_a_text() {
    let model = ColmapModel::from_scene(&scene());
    let folder = Folder::new();
    folder
        .colmap_text("sparse/0", &model)
        .pictures(&scene(), |name| format!("photos/{name}"));
    for name in ["cameras", "images", "points3D"] {
        let path = format!("sparse/0/{name}.txt");
        let marked = [&b"\xef\xbb\xbf"[..], &fs::read(folder.at(&path)).unwrap()].concat();
        folder.write(&path, marked);
    }
    let read = folder.read();
    assert_eq!(
        (read.views.len(), read.observations()),
        (9, scene().observations())
    );
    assert_eq!(
        folder.open().images.unwrap().to_path_buf(),
        folder.at("photos")
    );
    let json = "\u{feff}[{\"cameras\":{},\"shots\":{}}]";
    let other = Folder::new();
    other.write("reconstruction.json", json);
    assert_eq!(other.read().views.len(), 0);
}
