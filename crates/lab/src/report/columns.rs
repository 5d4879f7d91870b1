//! Writes tables as Parquet files, one column per attribute, for pandas and DuckDB.

use std::sync::Arc;

use super::Error;

use parquet::basic::{ConvertedType, Repetition, Type as Physical};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::Type;

/// The values of one column. All columns of a table must have the same length.
#[derive(Debug, Clone)]
pub enum Column {
    /// Text, stored as UTF-8.
    Text(Vec<String>),
    /// Integers.
    Whole(Vec<i64>),
    /// Real numbers; NaN stands for a missing value.
    Real(Vec<f64>),
}

impl Column {
    fn schema(&self, name: &str) -> Result<Type, ParquetError> {
        let (physical, converted) = match self {
            Self::Text(_) => (Physical::BYTE_ARRAY, ConvertedType::UTF8),
            Self::Whole(_) => (Physical::INT64, ConvertedType::NONE),
            Self::Real(_) => (Physical::DOUBLE, ConvertedType::NONE),
        };

        // Columns have no nulls (REQUIRED): a missing number is NaN.
        let builder =
            Type::primitive_type_builder(name, physical).with_repetition(Repetition::REQUIRED);

        builder.with_converted_type(converted).build()
    }
}

/// The bytes of a Parquet file with the named columns, in order.
///
/// # Errors
/// [`Error::Parquet`] if the library rejects the schema or a column.
pub fn parquet_file(columns: &[(&str, Column)]) -> Result<Vec<u8>, Error> {
    let mut fields = Vec::with_capacity(columns.len());
    for (name, column) in columns {
        fields.push(Arc::new(column.schema(name)?));
    }

    let schema = Arc::new(
        Type::group_type_builder("runs")
            .with_fields(fields)
            .build()?,
    );

    let mut file = Vec::new();
    let mut writer = SerializedFileWriter::new(
        &mut file,
        schema,
        Arc::new(WriterProperties::builder().build()),
    )?;

    // Write all rows as one row group, its columns in schema order.
    let mut group = writer.next_row_group()?;

    for (_, column) in columns {
        let Some(mut into) = group.next_column()? else {
            break;
        };
        match column {
            Column::Text(values) => {
                let values: Vec<ByteArray> =
                    values.iter().map(|value| value.as_str().into()).collect();
                into.typed::<ByteArrayType>()
                    .write_batch(&values, None, None)?;
            }
            Column::Whole(values) => {
                into.typed::<Int64Type>().write_batch(values, None, None)?;
            }
            Column::Real(values) => {
                into.typed::<DoubleType>().write_batch(values, None, None)?;
            }
        }

        into.close()?;
    }

    group.close()?;
    writer.close()?;

    Ok(file)
}
