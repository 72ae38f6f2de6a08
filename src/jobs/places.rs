//! Where everything is kept, and that database and objects belong together.

use std::path::{Path, PathBuf};

use super::{
    blobs::{Blobs, BucketName},
    error::{Error, Result},
    store::{Address, Store},
};

/// Where everything is kept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Places {
    /// What belongs to this server alone.
    pub data_dir: PathBuf,
    /// Jobs; SQLite in the data directory when absent.
    pub database: Option<Address>,
    /// Objects; in the data directory when absent.
    pub bucket: Option<BucketName>,
}

impl From<&Path> for Places {
    fn from(data_dir: &Path) -> Self {
        Self { data_dir: data_dir.into(), database: None, bucket: None }
    }
}

impl Places {
    pub(super) async fn store(&self) -> Result<Store> {
        match &self.database {
            Some(address) => Store::open(address).await,
            None => Store::open(&Address::file(&self.data_dir.join("jobs.sqlite3"))?).await,
        }
    }

    pub(super) fn blobs(&self) -> Result<Blobs> {
        Blobs::open(&self.objects(), self.bucket.as_ref())
    }

    fn objects(&self) -> PathBuf {
        self.data_dir.join("objects")
    }

    /// Refuses a database that tells of other objects than these. A server that has its own objects,
    /// where several share a database, would promise what the others do not find.
    pub(super) async fn check_pair(&self, store: &Store, blobs: &Blobs) -> Result<()> {
        let (known, found) = (store.objects_id().await?, blobs.id().await?);
        match (known, found) {
            (Some(known), Some(found)) if known == found => return Ok(()),
            // New objects for a database that tells of none yet.
            (Some(known), None) if store.n_meshes().await? == 0 => {
                return blobs.set_id(&known).await;
            }
            (None, found) => {
                let id = found.unwrap_or_else(|| uuid::Uuid::new_v4().simple().to_string());
                blobs.set_id(&id).await?;
                let known = store.name_objects(&id).await?;
                // Another server that is new may have been faster.
                return if known == id { Ok(()) } else { blobs.set_id(&known).await };
            }
            _ => {}
        }
        let at = self
            .bucket
            .as_ref()
            .map_or_else(|| self.objects().display().to_string(), ToString::to_string);
        Err(Error::OtherObjects(at))
    }
}
