//! Writes tables as Parquet files, one column per attribute, for pandas and DuckDB.

use std::sync::Arc;

use super::Error;

use parquet::basic::{ConvertedType, Repetition, Type as Physical};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::Type;

/// A column of rows of type `R`: the value of a row.
pub enum ParquetColumn<R> {
    /// Text, stored as UTF-8.
    Text(fn(&R) -> &str),
    /// Integers.
    Whole(fn(&R) -> u64),
    /// Real numbers; NaN stands for a missing value.
    Real(fn(&R) -> f64),
}

impl<R> ParquetColumn<R> {
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

/// The bytes of a Parquet file of rows, with the named columns in order.
///
/// # Errors
/// [`Error::Parquet`] if the library rejects the schema or a column.
pub fn parquet_file<R>(rows: &[R], columns: &[(&str, ParquetColumn<R>)]) -> Result<Vec<u8>, Error> {
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
            ParquetColumn::Text(of) => {
                let values: Vec<ByteArray> = rows.iter().map(|row| of(row).into()).collect();
                into.typed::<ByteArrayType>()
                    .write_batch(&values, None, None)?;
            }
            ParquetColumn::Whole(of) => {
                let values: Vec<i64> = rows.iter().map(|row| of(row) as i64).collect();
                into.typed::<Int64Type>().write_batch(&values, None, None)?;
            }
            ParquetColumn::Real(of) => {
                let values: Vec<f64> = rows.iter().map(of).collect();
                into.typed::<DoubleType>()
                    .write_batch(&values, None, None)?;
            }
        }

        into.close()?;
    }

    group.close()?;
    writer.close()?;

    Ok(file)
}
