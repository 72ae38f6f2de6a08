//! Calls between servers that share a PostgreSQL: NOTIFY and LISTEN. What is called is the caller's
//! business.

use sqlx::postgres::PgListener;

use super::{Error, Result, Store};

const CHANNEL: &str = "lookalike";

/// What a listener may come upon.
#[derive(Debug)]
pub enum Heard {
    /// Somebody called.
    Call(String),
    /// The connection was lost and is back: calls may have been missed.
    Gap,
    /// The connection is lost.
    Nothing(Error),
}

/// Hears what all servers call, this one included.
#[derive(Debug)]
pub struct Ear(PgListener);

impl Ear {
    /// Waits for the next call.
    pub async fn next(&mut self) -> Heard {
        match self.0.try_recv().await {
            Ok(Some(call)) => Heard::Call(call.payload().into()),
            Ok(None) => Heard::Gap,
            Err(error) => Heard::Nothing(error.into()),
        }
    }
}

impl Store {
    /// Other servers may use the same database.
    pub fn is_shared(&self) -> bool {
        self.address.is_shared()
    }

    /// Calls out to all servers.
    pub async fn call(&self, calls: impl IntoIterator<Item = String>) -> Result<()> {
        let mut conn = self.readers.acquire().await?;
        for call in calls {
            let notify = sqlx::query("SELECT 1 FROM pg_notify($1, $2)").bind(CHANNEL).bind(call);
            notify.execute(&mut *conn).await?;
        }
        Ok(())
    }

    /// Begins to listen.
    pub async fn listen(&self) -> Result<Ear> {
        let mut listener = PgListener::connect(self.address.url()).await?;
        listener.listen(CHANNEL).await?;
        Ok(Ear(listener))
    }
}
