"""The parts of a glTF 2.0 document that are read, validated by type and range; everything else is ignored.

Names are those of the specification (Khronos, glTF 2.0, and the extensions named here).
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel

Index = Annotated[int, Field(ge=0, lt=1 << 31)]
Count = Annotated[int, Field(ge=0, lt=1 << 48)]
Unit = Annotated[float, AfterValidator(lambda value: min(max(value, 0.0), 1.0))]
"""A number from 0 to 1, clamped because exporters write 1.0000001."""
Positive = Annotated[float, AfterValidator(lambda value: max(value, 0.0))]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Colour = tuple[Positive, Positive, Positive]
Matrix = Annotated[list[float], Field(min_length=16, max_length=16)]


class Part(BaseModel):
    """A part of the document."""

    model_config = ConfigDict(
        alias_generator=to_camel, frozen=True, extra="ignore", allow_inf_nan=False, populate_by_name=True
    )


class Named(Part):
    """A part with a name."""

    name: str = ""


class Asset(Part):
    """Version of the format, and the program that wrote the file."""

    version: str
    generator: str = ""


class Buffer(Part):
    """Bytes, in the file or in a separate one."""

    byte_length: Count
    uri: str | None = None


class BufferView(Part):
    """A part of a buffer."""

    buffer: Index
    byte_length: Count
    byte_offset: Count = 0
    byte_stride: Annotated[int, Field(ge=1, le=252)] | None = None


class SparseIndices(Part):
    """Indices of the elements that differ."""

    buffer_view: Index
    component_type: int
    byte_offset: Count = 0


class SparseValues(Part):
    """Values of the elements that differ."""

    buffer_view: Index
    byte_offset: Count = 0


class Sparse(Part):
    """Elements that differ from the rest of an accessor."""

    count: Count
    indices: SparseIndices
    values: SparseValues


class Accessor(Part):
    """An array in a buffer view."""

    component_type: int
    count: Count
    type: str
    buffer_view: Index | None = None
    byte_offset: Count = 0
    normalized: bool = False
    sparse: Sparse | None = None


class Sampler(Part):
    """How an image is looked up."""

    mag_filter: int | None = None
    wrap_s: int = 10497
    wrap_t: int = 10497


class Image(Named):
    """An image, in the file or in a separate one."""

    uri: str | None = None
    buffer_view: Index | None = None


class WebP(Part):
    """EXT_texture_webp."""

    source: Index


class TextureExtensions(Part):
    """Extensions of a texture."""

    webp: WebP | None = Field(None, alias="EXT_texture_webp")


class Texture(Named):
    """An image and a sampler."""

    sampler: Index | None = None
    source: Index | None = None
    extensions: TextureExtensions = TextureExtensions()


class TextureTransform(Part):
    """KHR_texture_transform."""

    offset: Vector2 = (0.0, 0.0)
    rotation: float = 0.0
    scale: Vector2 = (1.0, 1.0)
    tex_coord: Index | None = None


class TextureInfoExtensions(Part):
    """Extensions of a texture reference."""

    transform: TextureTransform | None = Field(None, alias="KHR_texture_transform")


class TextureInfo(Part):
    """A reference to a texture."""

    index: Index
    tex_coord: Index = 0
    scale: float = 1.0
    extensions: TextureInfoExtensions = TextureInfoExtensions()


class MetallicRoughness(Part):
    """The basic material."""

    base_color_factor: tuple[Unit, Unit, Unit, Unit] = (1.0, 1.0, 1.0, 1.0)
    base_color_texture: TextureInfo | None = None
    metallic_factor: Unit = 1.0
    roughness_factor: Unit = 1.0
    metallic_roughness_texture: TextureInfo | None = None


class SpecularGlossiness(Part):
    """KHR_materials_pbrSpecularGlossiness."""

    diffuse_factor: tuple[Unit, Unit, Unit, Unit] = (1.0, 1.0, 1.0, 1.0)
    diffuse_texture: TextureInfo | None = None
    specular_factor: Colour = (1.0, 1.0, 1.0)
    glossiness_factor: Unit = 1.0
    specular_glossiness_texture: TextureInfo | None = None


class Transmission(Part):
    """KHR_materials_transmission."""

    transmission_factor: Unit = 0.0
    transmission_texture: TextureInfo | None = None


class Volume(Part):
    """KHR_materials_volume."""

    thickness_factor: Positive = 0.0
    attenuation_distance: Annotated[float, Field(gt=0)] | None = None
    attenuation_color: Colour = (1.0, 1.0, 1.0)


class Ior(Part):
    """KHR_materials_ior; 0 stands for infinity."""

    ior: Positive = 1.5


class Specular(Part):
    """KHR_materials_specular."""

    specular_factor: Unit = 1.0
    specular_texture: TextureInfo | None = None
    specular_color_factor: Colour = (1.0, 1.0, 1.0)
    specular_color_texture: TextureInfo | None = None


class Clearcoat(Part):
    """KHR_materials_clearcoat."""

    clearcoat_factor: Unit = 0.0
    clearcoat_texture: TextureInfo | None = None
    clearcoat_roughness_factor: Unit = 0.0
    clearcoat_roughness_texture: TextureInfo | None = None


class EmissiveStrength(Part):
    """KHR_materials_emissive_strength."""

    emissive_strength: Positive = 1.0


class MaterialExtensions(Part):
    """Extensions of a material."""

    transmission: Transmission | None = Field(None, alias="KHR_materials_transmission")
    volume: Volume | None = Field(None, alias="KHR_materials_volume")
    ior: Ior | None = Field(None, alias="KHR_materials_ior")
    specular: Specular | None = Field(None, alias="KHR_materials_specular")
    clearcoat: Clearcoat | None = Field(None, alias="KHR_materials_clearcoat")
    emissive_strength: EmissiveStrength | None = Field(None, alias="KHR_materials_emissive_strength")
    unlit: dict[str, Any] | None = Field(None, alias="KHR_materials_unlit")
    specular_glossiness: SpecularGlossiness | None = Field(None, alias="KHR_materials_pbrSpecularGlossiness")
    sheen: dict[str, Any] | None = Field(None, alias="KHR_materials_sheen")
    iridescence: dict[str, Any] | None = Field(None, alias="KHR_materials_iridescence")
    anisotropy: dict[str, Any] | None = Field(None, alias="KHR_materials_anisotropy")
    dispersion: dict[str, Any] | None = Field(None, alias="KHR_materials_dispersion")
    diffuse_transmission: dict[str, Any] | None = Field(None, alias="KHR_materials_diffuse_transmission")
    volume_scatter: dict[str, Any] | None = Field(None, alias="KHR_materials_volume_scatter")


class Material(Named):
    """A material."""

    pbr_metallic_roughness: MetallicRoughness = MetallicRoughness()
    normal_texture: TextureInfo | None = None
    occlusion_texture: TextureInfo | None = None
    emissive_texture: TextureInfo | None = None
    emissive_factor: Colour = (0.0, 0.0, 0.0)
    alpha_mode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alpha_cutoff: Positive = 0.5
    double_sided: bool = False
    extensions: MaterialExtensions = MaterialExtensions()


class Draco(Part):
    """KHR_draco_mesh_compression."""

    buffer_view: Index
    attributes: dict[str, Index]


class PrimitiveExtensions(Part):
    """Extensions of a primitive."""

    draco: Draco | None = Field(None, alias="KHR_draco_mesh_compression")


class Primitive(Part):
    """Geometry of one material."""

    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: int = 4
    targets: list[dict[str, Index]] = Field(default_factory=list)
    extensions: PrimitiveExtensions = PrimitiveExtensions()


class Mesh(Named):
    """Primitives that belong together."""

    primitives: list[Primitive]
    weights: list[float] = Field(default_factory=list)


class Skin(Named):
    """Joints that move a mesh."""

    joints: list[Index]
    inverse_bind_matrices: Index | None = None


class Perspective(Part):
    """A perspective camera; angle in radians."""

    yfov: Annotated[float, Field(gt=0, lt=3.14159)]
    znear: Positive = 0.0
    aspect_ratio: Annotated[float, Field(gt=1e-3, lt=1e3)] | None = None


class Orthographic(Part):
    """An orthographic camera: half its width and height."""

    xmag: float
    ymag: float
    znear: float = 0.0


class Camera(Named):
    """A camera."""

    type: Literal["perspective", "orthographic"]
    perspective: Perspective | None = None
    orthographic: Orthographic | None = None


class Spot(Part):
    """Cone of a spot light, radians from its axis."""

    inner_cone_angle: Annotated[float, Field(ge=0, lt=1.5709)] = 0.0
    outer_cone_angle: Annotated[float, Field(gt=0, lt=1.5709)] = 0.7853981633974483


class Light(Named):
    """KHR_lights_punctual: intensity in candela, or lux for a directional light."""

    type: Literal["point", "spot", "directional"]
    color: Colour = (1.0, 1.0, 1.0)
    intensity: Positive = 1.0
    range: float | None = None
    spot: Spot = Spot()


class LightTable(Part):
    """KHR_lights_punctual of the document."""

    lights: list[Light] = Field(default_factory=list)


class LightUse(Part):
    """KHR_lights_punctual of a node."""

    light: Index


class Instancing(Part):
    """EXT_mesh_gpu_instancing: accessors by TRANSLATION, ROTATION, SCALE."""

    attributes: dict[str, Index]


class Visibility(Part):
    """KHR_node_visibility: whether a node and all below it are shown."""

    visible: bool = True


class NodeExtensions(Part):
    """Extensions of a node."""

    light: LightUse | None = Field(None, alias="KHR_lights_punctual")
    instancing: Instancing | None = Field(None, alias="EXT_mesh_gpu_instancing")
    visibility: Visibility = Field(Visibility(), alias="KHR_node_visibility")


class Node(Named):
    """A node of the scene, placed relative to its parent."""

    children: list[Index] = Field(default_factory=list)
    camera: Index | None = None
    mesh: Index | None = None
    skin: Index | None = None
    matrix: Matrix | None = None
    translation: Vector3 = (0.0, 0.0, 0.0)
    rotation: Vector4 = (0.0, 0.0, 0.0, 1.0)
    scale: Vector3 = (1.0, 1.0, 1.0)
    weights: list[float] = Field(default_factory=list)
    extensions: NodeExtensions = NodeExtensions()


class Pointer(Part):
    """KHR_animation_pointer: what is animated, as a JSON pointer."""

    pointer: str


class TargetExtensions(Part):
    """Extensions of a target."""

    pointer: Pointer | None = Field(None, alias="KHR_animation_pointer")


class Target(Part):
    """What is animated."""

    path: str
    node: Index | None = None
    extensions: TargetExtensions = TargetExtensions()


class Channel(Part):
    """A curve, and what it animates."""

    sampler: Index
    target: Target


class AnimationSampler(Part):
    """A curve: times and values."""

    input: Index
    output: Index
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class Animation(Named):
    """Curves that belong together."""

    channels: list[Channel] = Field(default_factory=list)
    samplers: list[AnimationSampler] = Field(default_factory=list)


class Scene(Named):
    """Nodes that are shown together."""

    nodes: list[Index] = Field(default_factory=list)


class DocumentExtensions(Part):
    """Extensions of the document."""

    lights: LightTable = Field(LightTable(), alias="KHR_lights_punctual")


class Document(Part):
    """A glTF document."""

    asset: Asset
    accessors: list[Accessor] = Field(default_factory=list)
    animations: list[Animation] = Field(default_factory=list)
    buffers: list[Buffer] = Field(default_factory=list)
    buffer_views: list[BufferView] = Field(default_factory=list)
    cameras: list[Camera] = Field(default_factory=list)
    images: list[Image] = Field(default_factory=list)
    materials: list[Material] = Field(default_factory=list)
    meshes: list[Mesh] = Field(default_factory=list)
    nodes: list[Node] = Field(default_factory=list)
    samplers: list[Sampler] = Field(default_factory=list)
    scene: Index | None = None
    scenes: list[Scene] = Field(default_factory=list)
    skins: list[Skin] = Field(default_factory=list)
    textures: list[Texture] = Field(default_factory=list)
    extensions_used: list[str] = Field(default_factory=list)
    extensions_required: list[str] = Field(default_factory=list)
    extensions: DocumentExtensions = DocumentExtensions()


SUPPORTED: Final = frozenset(
    {
        "EXT_mesh_gpu_instancing",
        "EXT_texture_webp",
        "KHR_animation_pointer",
        "KHR_draco_mesh_compression",
        "KHR_lights_punctual",
        "KHR_materials_clearcoat",
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_pbrSpecularGlossiness",
        "KHR_materials_specular",
        "KHR_materials_transmission",
        "KHR_materials_unlit",
        "KHR_materials_volume",
        "KHR_mesh_quantization",
        "KHR_node_visibility",
        "KHR_texture_transform",
    }
)
"""Supported extensions."""

HARMLESS: Final = frozenset(
    {
        *("KHR_materials_sheen", "KHR_materials_iridescence", "KHR_materials_anisotropy"),
        *("KHR_materials_dispersion", "KHR_materials_diffuse_transmission", "KHR_materials_volume_scatter"),
        *("KHR_materials_variants", "KHR_xmp_json_ld", "KHR_xmp"),
    }
)
"""Extensions that may be ignored without affecting the rest of a scene, even if a file requires them."""
