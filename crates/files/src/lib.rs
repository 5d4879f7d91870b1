//! Opens only regular files: a named pipe in the place of a file would block, a device might never
//! end.

use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// Maximum size of configuration files, credentials and tokens, bytes.
pub const SMALL_FILE_BYTES: u64 = 16 << 20;
/// Maximum size of an encoded image, bytes.
pub const IMAGE_FILE_BYTES: u64 = 256 << 20;

/// Opens a regular file for reading, or a link to one. Does not block on other files.
///
/// # Errors
/// [`io::ErrorKind::InvalidInput`] if it is not a regular file; otherwise the error of opening it.
pub fn open(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.read(true);

    // Opening a named pipe waits for a writer otherwise. On a regular file the flag does nothing.
    #[cfg(unix)]
    {
        use std::os::unix::fs::OpenOptionsExt;
        options.custom_flags(rustix::fs::OFlags::NONBLOCK.bits() as i32);
    }

    let file = options.open(path)?;
    if file.metadata()?.is_file() {
        return Ok(file);
    }
    Err(io::Error::new(
        io::ErrorKind::InvalidInput,
        "is not a regular file",
    ))
}

/// Reads a regular file of at most `most` bytes.
///
/// # Errors
/// [`io::ErrorKind::FileTooLarge`] if it is larger; otherwise as [`open`].
pub fn read(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let file = open(path)?;
    let length = file.metadata()?.len();
    let too_large = || {
        let problem = format!("is larger than {most} bytes");
        io::Error::new(io::ErrorKind::FileTooLarge, problem)
    };
    if length > most {
        return Err(too_large());
    }

    // The file may grow while it is read.
    let mut bytes = Vec::with_capacity(usize::try_from(length).unwrap_or(0));
    file.take(most.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        return Err(too_large());
    }
    Ok(bytes)
}

/// Reads a regular text file of at most `most` bytes.
///
/// # Errors
/// [`io::ErrorKind::InvalidData`] if it is not UTF-8; otherwise as [`read`].
pub fn read_text(path: &Path, most: u64) -> io::Result<String> {
    let bytes = read(path, most)?;
    String::from_utf8(bytes)
        .map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "is not UTF-8 text"))
}

/// Opens a regular file below `root`, also through links inside `root`.
///
/// # Errors
/// [`io::ErrorKind::InvalidInput`] if a link leads out of `root`; otherwise as [`open`].
pub fn open_below(root: &Path, file: &Path) -> io::Result<File> {
    let path = root.join(file);
    let opened = open(&path)?;
    if location(&opened, &path)?.starts_with(root.canonicalize()?) {
        return Ok(opened);
    }
    Err(io::Error::new(
        io::ErrorKind::InvalidInput,
        "is a link to a file outside the folder; copy the file into it",
    ))
}

/// Where an open file is. The path may lead elsewhere by now, so Linux is asked for the
/// descriptor's.
fn location(opened: &File, path: &Path) -> io::Result<PathBuf> {
    #[cfg(target_os = "linux")]
    {
        use std::os::fd::AsRawFd;
        let link = format!("/proc/self/fd/{}", opened.as_raw_fd());
        if let Ok(location) = std::fs::read_link(link) {
            return Ok(location);
        }
    }
    let _ = opened;
    path.canonicalize()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use super::*;

    /// Oracle: the contract, for a file of ten bytes.
    #[test]
    fn a_file_is_read_up_to_its_limit() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("ten");
        std::fs::write(&file, "ten bytes!").unwrap();
        assert_eq!(read(&file, 10).unwrap(), b"ten bytes!");
        assert_eq!(read_text(&file, 10).unwrap(), "ten bytes!");

        let error = read(&file, 9).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
        std::fs::write(&file, [0xff]).unwrap();
        let error = read_text(&file, 10).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::InvalidData);
    }

    /// Oracle: the contract. Without the check, the pipe would block and the device never end.
    #[cfg(unix)]
    #[test]
    fn pipes_devices_and_folders_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        rustix::fs::mknodat(
            rustix::fs::CWD,
            &pipe,
            rustix::fs::FileType::Fifo,
            rustix::fs::Mode::RUSR,
            0,
        )
        .unwrap();
        let device = folder.path().join("zeros");
        std::os::unix::fs::symlink("/dev/zero", &device).unwrap();

        for path in [pipe.as_path(), &device, folder.path()] {
            let error = read(path, 1 << 30).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::InvalidInput, "{path:?}");
        }
    }

    /// Oracle: the contract: links inside the folder are followed, links out of it are refused.
    #[cfg(unix)]
    #[test]
    fn links_lead_only_inside() {
        use std::os::unix::fs::symlink;

        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("recording");
        std::fs::create_dir(&root).unwrap();
        std::fs::write(root.join("in.png"), "in").unwrap();
        std::fs::write(folder.path().join("out.png"), "out").unwrap();
        symlink("in.png", root.join("inside")).unwrap();
        symlink("../out.png", root.join("outside")).unwrap();

        for file in ["in.png", "inside"] {
            let opened = open_below(&root, Path::new(file)).unwrap();
            assert_eq!(io::read_to_string(opened).unwrap(), "in");
        }
        let error = open_below(&root, Path::new("outside")).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::InvalidInput);
    }

    /// Oracle: the contract, while another thread repeatedly retargets a link of a folder.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_replaced_link_leads_only_inside() {
        use std::os::unix::fs::symlink;
        use std::sync::atomic::{AtomicBool, Ordering};

        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("recording");
        for (name, text) in [("recording/inside", "in"), ("outside", "out")] {
            let within = folder.path().join(name);
            std::fs::create_dir_all(&within).unwrap();
            std::fs::write(within.join("a.png"), text).unwrap();
        }
        symlink("inside", root.join("link")).unwrap();

        let is_done = AtomicBool::new(false);
        let read = std::thread::scope(|scope| {
            scope.spawn(|| {
                let next = root.join("next");
                for target in ["../outside", "inside"].into_iter().cycle() {
                    if is_done.load(Ordering::Relaxed) {
                        return;
                    }
                    symlink(target, &next).unwrap();
                    std::fs::rename(&next, root.join("link")).unwrap();
                }
            });
            let opened =
                (0..20_000).filter_map(|_| open_below(&root, Path::new("link/a.png")).ok());
            let read: Vec<String> = opened.flat_map(io::read_to_string).collect();
            is_done.store(true, Ordering::Relaxed);
            read
        });
        assert!(read.len() > 100, "{}", read.len());
        assert!(read.iter().all(|text| text == "in"));
    }
}
