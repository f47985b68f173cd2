/* Stands in for a kernel with CAN, for one test: a raw CAN socket becomes a connection to the Unix socket that CAN_SHIM
 * names, on which frames go as the 16 bytes of struct can_frame. Preloaded; knows one interface, vcan0. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <net/if.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/un.h>

enum { INTERFACE = 7 };
static int shimmed = -1;

int socket(int domain, int type, int protocol)
{
    int (*real)(int, int, int) = (int (*)(int, int, int))dlsym(RTLD_NEXT, "socket");
    const char *path = getenv("CAN_SHIM");
    if (domain != AF_CAN || !path)
        return real(domain, type, protocol);
    int fd = real(AF_UNIX, SOCK_STREAM | (type & (SOCK_CLOEXEC | SOCK_NONBLOCK)), 0);
    struct sockaddr_un address = { .sun_family = AF_UNIX };
    strncpy(address.sun_path, path, sizeof address.sun_path - 1);
    if (fd >= 0 && connect(fd, (struct sockaddr *)&address, sizeof address) == 0)
        shimmed = fd;
    return fd;
}

int bind(int fd, const struct sockaddr *address, socklen_t len)
{
    int (*real)(int, const struct sockaddr *, socklen_t) =
        (int (*)(int, const struct sockaddr *, socklen_t))dlsym(RTLD_NEXT, "bind");
    return fd == shimmed ? 0 : real(fd, address, len);
}

int setsockopt(int fd, int level, int name, const void *value, socklen_t len)
{
    int (*real)(int, int, int, const void *, socklen_t) =
        (int (*)(int, int, int, const void *, socklen_t))dlsym(RTLD_NEXT, "setsockopt");
    /* SOL_CAN_BASE and above. */
    return fd == shimmed && level >= 100 ? 0 : real(fd, level, name, value, len);
}

unsigned int if_nametoindex(const char *name)
{
    if (strcmp(name, "vcan0") == 0)
        return INTERFACE;
    errno = ENODEV;
    return 0;
}
