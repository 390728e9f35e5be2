/* A libusb-1.0.so.0 whose only device is behind a Unix socket, for libdc1394: see firefly_socket.py.
 *
 * What libdc1394 calls, no more. $IIDC_USB_SOCKET is where the device listens; nobody there is no device.
 * Each open handle is a connection of its own: for control requests, or, once an interface is claimed, one
 * more for bulk reads. $IIDC_USB_ON_RELEASE=hang or =crash is how libdc1394's stop of a capture can end
 * after an unplug on real USB.
 */
#include <libusb-1.0/libusb.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define MOST 64

struct libusb_context { struct libusb_device_handle *bulk; };
struct libusb_device { struct libusb_context *context; };
struct libusb_device_handle {
    struct libusb_device device;
    int control, bulk;
    pthread_mutex_t lock;
    struct libusb_transfer *pending[MOST];
    int count;
};

static int reach(char purpose)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    const char *path = getenv("IIDC_USB_SOCKET");
    int fd;
    if (!path || strlen(path) >= sizeof address.sun_path)
        return -1;
    strcpy(address.sun_path, path);
    fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd >= 0 && (connect(fd, (struct sockaddr *)&address, sizeof address) || write(fd, &purpose, 1) != 1)) {
        close(fd);
        return -1;
    }
    return fd;
}

/* All of it, or -1 when the other end is gone or the time is up; 0 ms is for ever. */
static int take(int fd, void *into, size_t size, unsigned timeout_ms)
{
    char *at = into;
    while (size) {
        struct pollfd wait = {.fd = fd, .events = POLLIN};
        ssize_t got;
        if (timeout_ms && poll(&wait, 1, (int)timeout_ms) != 1)
            return -1;
        got = recv(fd, at, size, 0);
        if (got <= 0)
            return -1;
        at += got;
        size -= (size_t)got;
    }
    return 0;
}

static int give(int fd, const void *from, size_t size)
{
    return send(fd, from, size, MSG_NOSIGNAL) == (ssize_t)size ? 0 : -1;
}

int libusb_init(libusb_context **context)
{
    *context = calloc(1, sizeof **context);
    return 0;
}

void libusb_exit(libusb_context *context) { free(context); }

ssize_t libusb_get_device_list(libusb_context *context, libusb_device ***list)
{
    int fd = reach('?');
    *list = calloc(2, sizeof **list);
    if (fd < 0)
        return 0;
    close(fd);
    (*list)[0] = calloc(1, sizeof ***list);
    (*list)[0]->context = context;
    return 1;
}

void libusb_free_device_list(libusb_device **list, int unref)
{
    (void)unref; /* the devices stay: handles copied what they need, and libdc1394 may still hold one */
    free(list);
}

int libusb_get_device_descriptor(libusb_device *device, struct libusb_device_descriptor *descriptor)
{
    (void)device;
    memset(descriptor, 0, sizeof *descriptor);
    descriptor->idVendor = 0x1e10;
    descriptor->idProduct = 0x2000;
    descriptor->bNumConfigurations = 1;
    return 0;
}

static const struct libusb_endpoint_descriptor endpoint = {.bEndpointAddress = 0x81};
static const struct libusb_interface_descriptor setting = {.bNumEndpoints = 1, .endpoint = &endpoint};
static const struct libusb_interface face = {.altsetting = &setting, .num_altsetting = 1};
static struct libusb_config_descriptor configuration = {.bNumInterfaces = 1, .interface = &face};

int libusb_get_active_config_descriptor(libusb_device *device, struct libusb_config_descriptor **config)
{
    (void)device;
    *config = &configuration;
    return 0;
}

uint8_t libusb_get_bus_number(libusb_device *device) { (void)device; return 1; }
uint8_t libusb_get_device_address(libusb_device *device) { (void)device; return 7; }
int libusb_get_device_speed(libusb_device *device) { (void)device; return LIBUSB_SPEED_HIGH; }
libusb_device *libusb_get_device(libusb_device_handle *handle) { return &handle->device; }
int libusb_reset_device(libusb_device_handle *handle) { (void)handle; return 0; }
int libusb_set_configuration(libusb_device_handle *handle, int number) { (void)handle; (void)number; return 0; }

int libusb_open(libusb_device *device, libusb_device_handle **handle)
{
    int fd = reach('C');
    if (fd < 0)
        return LIBUSB_ERROR_NO_DEVICE;
    *handle = calloc(1, sizeof **handle);
    (*handle)->device = *device;
    (*handle)->control = fd;
    (*handle)->bulk = -1;
    pthread_mutex_init(&(*handle)->lock, NULL);
    return 0;
}

void libusb_close(libusb_device_handle *handle)
{
    close(handle->control);
    if (handle->bulk >= 0)
        close(handle->bulk);
    free(handle);
}

int libusb_claim_interface(libusb_device_handle *handle, int number)
{
    (void)number;
    handle->bulk = reach('B');
    handle->device.context->bulk = handle;
    return handle->bulk < 0 ? LIBUSB_ERROR_NO_DEVICE : 0;
}

int libusb_release_interface(libusb_device_handle *handle, int number)
{
    const char *how = getenv("IIDC_USB_ON_RELEASE");
    (void)handle;
    (void)number;
    if (how && !strcmp(how, "hang"))
        for (;;)
            pause();
    if (how && !strcmp(how, "crash"))
        raise(SIGSEGV);
    return 0;
}

int libusb_control_transfer(libusb_device_handle *handle, uint8_t type, uint8_t request, uint16_t value,
                            uint16_t index, unsigned char *data, uint16_t length, unsigned timeout_ms)
{
    unsigned char head[8] = {type, request, value & 255, value >> 8, index & 255, index >> 8, length & 255,
                             length >> 8};
    int32_t status = LIBUSB_ERROR_NO_DEVICE;
    int in = type & LIBUSB_ENDPOINT_IN;
    if (give(handle->control, head, sizeof head) || (!in && give(handle->control, data, length)) ||
        take(handle->control, &status, sizeof status, timeout_ms) ||
        (in && status > 0 && take(handle->control, data, (size_t)status, timeout_ms)))
        return LIBUSB_ERROR_NO_DEVICE;
    return status;
}

struct libusb_transfer *libusb_alloc_transfer(int packets)
{
    (void)packets;
    return calloc(1, sizeof(struct libusb_transfer));
}

void libusb_free_transfer(struct libusb_transfer *transfer) { free(transfer); }

int libusb_submit_transfer(struct libusb_transfer *transfer)
{
    libusb_device_handle *handle = transfer->dev_handle;
    uint32_t length = (uint32_t)transfer->length;
    int result = 0;
    pthread_mutex_lock(&handle->lock);
    if (handle->count == MOST || give(handle->bulk, &length, sizeof length))
        result = LIBUSB_ERROR_NO_DEVICE;
    else
        handle->pending[handle->count++] = transfer;
    pthread_mutex_unlock(&handle->lock);
    return result;
}

/* Completes the oldest pending transfer with the next frame, or all of them when the device is gone. */
int libusb_handle_events_timeout(libusb_context *context, struct timeval *limit)
{
    libusb_device_handle *handle = context->bulk;
    struct pollfd wait = {.fd = handle ? handle->bulk : -1, .events = POLLIN};
    struct libusb_transfer *transfer;
    uint32_t size;
    int gone;
    if (poll(&wait, 1, (int)(limit->tv_sec * 1000 + limit->tv_usec / 1000)) != 1)
        return 0;
    do {
        gone = take(wait.fd, &size, sizeof size, 0);
        pthread_mutex_lock(&handle->lock);
        transfer = handle->count ? handle->pending[0] : NULL;
        if (transfer)
            memmove(handle->pending, handle->pending + 1, (size_t)--handle->count * sizeof transfer);
        pthread_mutex_unlock(&handle->lock);
        if (!transfer)
            break;
        gone = gone || size > (uint32_t)transfer->length || take(wait.fd, transfer->buffer, size, 0);
        transfer->actual_length = gone ? 0 : (int)size;
        transfer->status = gone ? LIBUSB_TRANSFER_NO_DEVICE : LIBUSB_TRANSFER_COMPLETED;
        transfer->callback(transfer);
    } while (gone);
    if (gone) { /* nothing can come any more: do not spin */
        struct timespec rest = {.tv_nsec = 50000000};
        nanosleep(&rest, NULL);
    }
    return 0;
}
