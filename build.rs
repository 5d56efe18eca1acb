//! Passes a fingerprint of the sources to the program: what another program has kept in a cache is
//! not believed.

use std::{
    fs,
    hash::{DefaultHasher, Hash, Hasher},
    io,
    path::{Path, PathBuf},
};

fn main() -> io::Result<()> {
    let mut hasher = DefaultHasher::new();
    // A package has no other crates, but names their exact versions.
    let folders = ["src", "crates/core/src", "crates/io/src"];
    let mut files = Vec::new();
    for folder in folders.map(Path::new).into_iter().filter(|f| f.is_dir()) {
        files.extend(files_in(folder)?);
        println!("cargo:rerun-if-changed={}", folder.display());
    }
    files.sort();
    // In a package of the library, the versions of its dependencies are the user's.
    files.extend(Some(PathBuf::from("Cargo.lock")).filter(|file| file.is_file()));
    for file in files {
        (file.to_string_lossy(), fs::read(&file)?).hash(&mut hasher);
    }
    println!("cargo:rerun-if-changed=Cargo.lock");
    println!("cargo:rustc-env=VIEWRANK_SOURCES={:016x}", hasher.finish());
    Ok(())
}

fn files_in(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            files.extend(files_in(&path)?)
        } else {
            files.push(path)
        }
    }
    Ok(files)
}
