"""Settings of every command: one dataclass per command and per group of settings.

The docstring below a field is its description in `--help`. A preset (`conf/<group>/<name>.yaml`)
sets the values that differ from the defaults. `check()` returns one message for
each invalid value or combination of values; a message names keys as the user types them.
"""

from dynapix.conf.schema.benchmark import (
    BenchmarkConfig,
    Quota,
    RetrievalTrackConfig,
    SelectionConfig,
)
from dynapix.conf.schema.commands import (
    BuildCommand,
    ClaimsCommand,
    CommandConfig,
    ContrastiveCommand,
    DistillCommand,
    ExportCommand,
    ExportModelCommand,
    GalleryCommand,
    NarrateCommand,
    ReinforceCommand,
    ServeCommand,
    SftCommand,
    StatisticsCommand,
)
from dynapix.conf.schema.evaluation import (
    EmbedderConfig,
    ExportStudyCommand,
    ReportCommand,
    RetrieveCommand,
    SelectCommand,
    SimilarityCommand,
    StudyCommand,
    TwoStageCommand,
)
from dynapix.conf.schema.models import (
    ArchitectureConfig,
    LateConfig,
    LoraConfig,
    RetrieverConfig,
    StudentConfig,
)
from dynapix.conf.schema.servers import (
    SamplingServerConfig,
    ServerConfig,
    ServersConfig,
    TeacherConfig,
    TeacherServerConfig,
)
from dynapix.conf.schema.training import (
    ContrastiveTrainConfig,
    DistillTrainConfig,
    ReinforceTrainConfig,
    RewardWeights,
    SftTrainConfig,
    StudentTrainConfig,
    TrainConfig,
)
from dynapix.conf.schema.world import CameraConfig, PartConfig, PhysicsConfig, WorldConfig
