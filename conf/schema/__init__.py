"""Every setting of every command: one dataclass a command and a group, with its unit and default.

Defaults here are the paper's values; a preset (`conf/<group>/<name>.yaml`) states what differs.
`check()` returns one sentence for each combination of values that cannot work, naming the keys as
a user types them.
"""

from conf.schema.benchmark import (
    BenchmarkConfig,
    Quota,
    RetrievalTrackConfig,
    SelectionConfig,
)
from conf.schema.commands import (
    PARALLEL_BACKENDS,
    BuildCommand,
    CommandConfig,
    ContrastiveCommand,
    ExportCommand,
    ExportModelCommand,
    GalleryCommand,
    NarrateCommand,
    ReportCommand,
    RetrieveCommand,
    SelectCommand,
    ServeCommand,
    SftCommand,
    SimilarityCommand,
    StatisticsCommand,
)
from conf.schema.models import (
    ArchitectureConfig,
    LateConfig,
    LoraConfig,
    RetrieverConfig,
    StudentConfig,
)
from conf.schema.servers import ImageServerConfig, ServerConfig, ServersConfig
from conf.schema.study import ExportStudyCommand, StudyCommand
from conf.schema.teacher import TeacherConfig
from conf.schema.training import ContrastiveTrainConfig, SftTrainConfig, TrainConfig
from conf.schema.two_stage import MatcherConfig, TwoStageCommand

__all__ = [
    "PARALLEL_BACKENDS",
    "ArchitectureConfig",
    "BenchmarkConfig",
    "BuildCommand",
    "CommandConfig",
    "ContrastiveCommand",
    "ContrastiveTrainConfig",
    "ExportCommand",
    "ExportModelCommand",
    "ExportStudyCommand",
    "GalleryCommand",
    "ImageServerConfig",
    "LateConfig",
    "LoraConfig",
    "MatcherConfig",
    "NarrateCommand",
    "Quota",
    "ReportCommand",
    "RetrievalTrackConfig",
    "RetrieveCommand",
    "RetrieverConfig",
    "SelectCommand",
    "SelectionConfig",
    "ServeCommand",
    "ServerConfig",
    "ServersConfig",
    "SftCommand",
    "SftTrainConfig",
    "SimilarityCommand",
    "StatisticsCommand",
    "StudentConfig",
    "StudyCommand",
    "TeacherConfig",
    "TrainConfig",
    "TwoStageCommand",
]
