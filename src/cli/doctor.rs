//! `lookalike doctor`: what this machine needs to run jobs, what is wrong, and how to mend it.

use std::{
    fs,
    net::{SocketAddr, TcpListener},
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use clap::Args;
use lookalike::{
    jobs::{
        Jobs,
        blobs::{Blobs, BucketName},
        error::Error,
        store::{Address, Store},
    },
    render::{AdapterInfo, adapters},
    service::tls::TlsFiles,
};

use super::{
    exit::{Exit, Failure},
    show,
};
use crate::config::{StoreArgs, TlsArgs};

/// Flags of `lookalike doctor`.
#[derive(Args, Debug)]
pub(crate) struct DoctorArgs {
    /// Also check this data directory.
    #[arg(long, env = "LOOKALIKE_DATA_DIR", value_name = "DIR")]
    data_dir: Option<PathBuf>,
    #[command(flatten)]
    stores: StoreArgs,
    #[command(flatten)]
    tls: TlsArgs,
    /// The server's address.
    #[arg(long, env = "LOOKALIKE_LISTEN", default_value = "127.0.0.1:7420")]
    listen: SocketAddr,
    /// One JSON object a line.
    #[arg(long)]
    json: bool,
}

/// Where Vulkan drivers register.
const DRIVER_FOLDERS: [&str; 3] =
    ["/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d"];

const DAY_SECS: i64 = 86_400;
/// A certificate that expires in less is told of.
const SOON_DAYS: i64 = 14;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Grade {
    Good,
    /// Works, with less than there could be.
    Fair,
    Bad,
}

/// One thing looked at.
#[derive(Debug)]
struct Finding {
    what: &'static str,
    grade: Grade,
    text: String,
}

pub(crate) async fn run(args: DoctorArgs) -> Result<(), Failure> {
    let mut findings = vec![vulkan(&driver_files()), devices(), port(args.listen)];
    let mut faults = Vec::new();
    let data_dir = args.data_dir.as_deref();
    let places = args.stores.places(data_dir.unwrap_or(Path::new(".")), &mut faults);
    let tls = args.tls.files(&mut faults);
    if !faults.is_empty() {
        return Err(Failure::faults(&faults));
    }
    findings.extend(tls.map(|files| certificate(&files, SystemTime::now())));
    if let Some(address) = &places.database {
        findings.push(database(address).await);
    }
    if let Some(bucket) = &places.bucket {
        findings.push(objects(bucket).await);
    }
    if let Some(data_dir) = data_dir.filter(|_| places.database.is_none()) {
        findings.push(store(data_dir).await);
    }
    for finding in &findings {
        show::print(&line(finding, args.json));
    }
    if findings.iter().any(|finding| finding.grade == Grade::Bad) {
        return Err(Failure::new(Exit::Failed, "something must be mended: see above"));
    }
    Ok(())
}

fn line(finding: &Finding, json: bool) -> String {
    let Finding { what, grade, text } = finding;
    let grade = match grade {
        Grade::Good => "good",
        Grade::Fair => "fair",
        Grade::Bad => "BAD",
    };
    if json {
        let grade = grade.to_lowercase();
        return format!("{}\n", serde_json::json!({"what": what, "grade": grade, "text": text}));
    }
    format!("{grade:<5} {what:<8} {text}\n")
}

fn vulkan(drivers: &[PathBuf]) -> Finding {
    let names: Vec<_> = drivers.iter().filter_map(|path| path.file_stem()?.to_str()).collect();
    let (grade, text) = if names.is_empty() {
        let text = "no Vulkan driver: jobs run on the native evaluator (--device cpu); for a graphics \
                    card install its driver, for the software rasterizer run `apt-get install \
                    mesa-vulkan-drivers`";
        (Grade::Fair, text.into())
    } else {
        (Grade::Good, format!("drivers: {}", names.join(", ")))
    };
    Finding { what: "vulkan", grade, text }
}

fn devices() -> Finding {
    let adapter = |a: &AdapterInfo| match &a.unfit {
        None => format!("{} ({}, {})", a.name, a.kind, a.driver),
        Some(why) => format!("{} (cannot be used: {why})", a.name),
    };
    let names: Vec<String> = adapters().iter().map(adapter).collect();
    let native = "the native evaluator (`--device cpu`)".to_owned();
    let text = std::iter::once(native).chain(names).collect::<Vec<_>>().join("; ");
    Finding { what: "devices", grade: Grade::Good, text }
}

fn driver_files() -> Vec<PathBuf> {
    let folders = DRIVER_FOLDERS.iter().filter_map(|folder| fs::read_dir(folder).ok());
    let mut files: Vec<_> = folders.flatten().flatten().map(|entry| entry.path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "json"));
    files.sort();
    files
}

fn port(address: SocketAddr) -> Finding {
    let (grade, text) = match TcpListener::bind(address) {
        Ok(_) => (Grade::Good, format!("{address} is free")),
        Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => {
            let text =
                "is in use, by a running server or by another program: `lookalike jobs` tells";
            (Grade::Fair, format!("{address} {text}"))
        }
        Err(error) => {
            (Grade::Bad, format!("{address} cannot be used ({error}): choose another --listen"))
        }
    };
    Finding { what: "port", grade, text }
}

/// Whether clients will trust the certificate, as far as its files tell.
fn certificate(files: &TlsFiles, now: SystemTime) -> Finding {
    let what = "tls";
    let now_secs = now.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs() as i64);
    let identity = match files.identity() {
        Ok(identity) => identity,
        Err(text) => {
            let text = format!("{text}; see --tls-cert, --tls-key and --tls-client-ca");
            return Finding { what, grade: Grade::Bad, text };
        }
    };
    let names = identity.names.join(", ");
    let (from, until) = identity.valid_secs;
    let n_days = (until - now_secs).div_euclid(DAY_SECS);
    let (grade, text) = if until < now_secs {
        (Grade::Bad, format!("{names}: the certificate has expired: renew it"))
    } else if from > now_secs {
        (Grade::Bad, format!("{names}: the certificate is not good yet: see this machine's clock"))
    } else if n_days < SOON_DAYS {
        (Grade::Fair, format!("{names}: the certificate expires in {n_days} days: renew it"))
    } else {
        (Grade::Good, format!("{names}: the certificate is good for {n_days} days"))
    };
    Finding { what, grade, text }
}

async fn database(address: &Address) -> Finding {
    let what = "database";
    match Store::probe(address).await {
        Ok((version, true)) => {
            Finding { what, grade: Grade::Good, text: format!("PostgreSQL {version} answers") }
        }
        Ok((version, false)) => {
            let text = format!(
                "PostgreSQL {version} answers, but this user may not make tables in the database: \
                 GRANT CREATE ON SCHEMA public, or make the user its owner"
            );
            Finding { what, grade: Grade::Bad, text }
        }
        Err(error) => {
            let text = format!("{error}; mend it, or choose another --database");
            Finding { what, grade: Grade::Bad, text }
        }
    }
}

async fn objects(bucket: &BucketName) -> Finding {
    let what = "objects";
    match Blobs::probe(bucket).await {
        Ok(()) => {
            let text = format!("{bucket}: written, read and removed");
            Finding { what, grade: Grade::Good, text }
        }
        Err(error) => {
            let text = format!(
                "{bucket}: {error}; check that the bucket exists, AWS_ACCESS_KEY_ID, \
                 AWS_SECRET_ACCESS_KEY, AWS_REGION and AWS_ENDPOINT_URL, or choose other --objects"
            );
            Finding { what, grade: Grade::Bad, text }
        }
    }
}

async fn store(data_dir: &Path) -> Finding {
    let what = "store";
    if !data_dir.exists() {
        return absent(data_dir);
    }
    match Jobs::inspect(data_dir).await {
        Ok(counts) => {
            let counts: Vec<_> = counts.iter().map(|(state, n)| format!("{n} {state}")).collect();
            let text = format!("{}: {}", data_dir.display(), counts.join(", "));
            Finding { what, grade: Grade::Good, text }
        }
        Err(Error::InUse(_)) => {
            let text = format!("{} is in use: a server has it open", data_dir.display());
            Finding { what, grade: Grade::Good, text }
        }
        Err(error) => {
            let text = format!("{error}; mend it, or choose another --data-dir");
            Finding { what, grade: Grade::Bad, text }
        }
    }
}

/// Whether a data directory that is not there can be made.
fn absent(data_dir: &Path) -> Finding {
    let what = "store";
    let at = data_dir.display();
    // Tried in the nearest folder there is, so that nothing is left but what was there.
    let above = data_dir.ancestors().skip(1).find(|path| path.exists()).unwrap_or(Path::new("."));
    let trial = above.join(format!(".lookalike-doctor-{}", std::process::id()));
    match fs::create_dir(&trial).and_then(|()| fs::remove_dir(&trial)) {
        Ok(()) => {
            let text = format!("{at} does not exist: `lookalike serve` will create it");
            Finding { what, grade: Grade::Fair, text }
        }
        Err(error) => {
            let above = above.display();
            let text = format!(
                "{at} does not exist, and nothing can be made in {above} ({error}): choose another \
                 --data-dir, or create it for this user"
            );
            Finding { what, grade: Grade::Bad, text }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_data_directory_that_cannot_be_made_is_a_fault() {
        let folder = std::env::temp_dir();
        assert_eq!(absent(&folder.join("not/there")).grade, Grade::Fair);
        assert_eq!(absent(Path::new("not-there")).grade, Grade::Fair);
        let finding = absent(Path::new("/proc/not/there"));
        assert_eq!(finding.grade, Grade::Bad);
        assert!(finding.text.contains("/proc/not/there"), "{}", finding.text);
    }

    #[test]
    fn certificates_are_good_for_a_time_and_with_their_key() {
        let folder = tempfile::tempdir().unwrap();
        let [cert, key, other] =
            ["cert.pem", "key.pem", "other.pem"].map(|f| folder.path().join(f));
        let mut params = rcgen::CertificateParams::new(vec!["farm.test".to_owned()]).unwrap();
        params.not_before = rcgen::date_time_ymd(2026, 1, 1);
        params.not_after = rcgen::date_time_ymd(2026, 3, 1);
        let pair = rcgen::KeyPair::generate().unwrap();
        fs::write(&cert, params.self_signed(&pair).unwrap().pem()).unwrap();
        fs::write(&key, pair.serialize_pem()).unwrap();
        fs::write(&other, rcgen::KeyPair::generate().unwrap().serialize_pem()).unwrap();
        let files = TlsFiles { cert, key, client_ca: None };
        // 2026-01-01, and days after it.
        let check = |files: &TlsFiles, day: i64, grade: Grade, text: &str| {
            let secs = 1_767_225_600 + day * DAY_SECS;
            let found =
                certificate(files, UNIX_EPOCH + std::time::Duration::from_secs(secs as u64));
            assert_eq!(found.grade, grade, "{found:?}");
            assert!(found.text.contains(text), "{found:?}");
        };
        check(&files, 9, Grade::Good, "farm.test: the certificate is good for 50 days");
        check(&files, 50, Grade::Fair, "expires in 9 days");
        check(&files, 60, Grade::Bad, "expired");
        check(&files, -1, Grade::Bad, "not good yet");
        check(&TlsFiles { key: other, ..files }, 9, Grade::Bad, "--tls-key");
    }

    #[test]
    fn a_missing_driver_names_its_package() {
        let finding = vulkan(&[]);
        assert_eq!(finding.grade, Grade::Fair);
        assert!(line(&finding, false).contains("mesa-vulkan-drivers"));
        assert!(vulkan(&["/x/lvp_icd.x86_64.json".into()]).text.contains("lvp_icd"));
    }
}
